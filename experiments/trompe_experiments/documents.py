"""Documents with figures made from data: a command fills the blocks between two comments.

    <!-- trompe: table_one of experiments/paper -->
    ...
    <!-- end -->

The first word is a name of ``figures.FIGURES``, the second the folder of an experiment relative to the document. The
block gets the figure, which is drawn into that folder, a link to its rows, and the stamp of its data.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from trompe_experiments.figures import FIGURES, read_data
from trompe_experiments.table import RESULTS
from trompe_shared.errors import SpecError

BEGIN = "<!-- trompe:"
BLOCK = re.compile(rf"^({BEGIN} (\w+) of ([^\n]+) -->\n)((?:(?!^{BEGIN}).)*?)(^<!-- end -->)", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class _Block:
    """A block: its figure, the folder of the data, the link to that folder, its present text."""

    figure: str
    folder: Path
    link: str
    present: str

    def text(self) -> str:
        """The text for the present data."""
        if not (self.folder / RESULTS).exists():
            return f"*Not measured yet: {self.link}/{RESULTS} is missing.*\n"
        data, kind = read_data(self.folder), FIGURES[self.figure]
        link = self.link.replace(" ", "%20")
        rows = f"Rows: [{RESULTS}]({link}/{RESULTS})\n" if kind.table else ""
        return f"\n![{kind.title}]({link}/figures/{self.figure}.svg)\n\n{rows}\n<!-- {data.stamp} -->\n"

    def outdated(self) -> Iterator[str]:
        """Messages about text or a figure made from other data."""
        if self.present != self.text():
            yield f"the block {self.figure} of {self.link} is not made from its data"
        svg = self.folder / "figures" / f"{self.figure}.svg"
        measured = (self.folder / RESULTS).exists()
        if measured and (not svg.exists() or read_data(self.folder).stamp not in svg.read_text("utf-8")):
            yield f"{self.link}/figures/{self.figure}.svg is not made from {self.link}/{RESULTS}"


def fill(document: Path) -> list[str]:
    """Draw all figures of ``document`` and rewrite its blocks; returns messages about the blocks that changed.

    Raises ``SpecError`` for an unknown figure, a block without its end, or an unreadable table.
    """
    text = document.read_text("utf-8")
    blocks = list(_blocks(document, text))
    for block in blocks:
        if (block.folder / RESULTS).exists():
            read_data(block.folder).draw(block.figure)
    changed, texts = outdated(document), (block.text() for block in blocks)
    document.write_text(BLOCK.sub(lambda match: f"{match[1]}{next(texts)}{match[5]}", text), "utf-8")
    return changed


def outdated(document: Path) -> list[str]:
    """Messages about blocks of ``document`` and figures that are not made from the present data."""
    blocks = _blocks(document, document.read_text("utf-8"))
    return [f"{document.name}: {message}" for block in blocks for message in block.outdated()]


def _blocks(document: Path, text: str) -> Iterator[_Block]:
    rest = BLOCK.sub("", text)
    if found := re.search(rf"^{BEGIN}.*", rest, re.MULTILINE):
        raise SpecError(
            f"{document.name}: {found[0]!r} begins no block; expected lines `{BEGIN} FIGURE of FOLDER -->` and, "
            "before the next one, `<!-- end -->`."
        )
    for match in BLOCK.finditer(text):
        if match[2] not in FIGURES:
            raise SpecError(f"{document.name}: unknown figure {match[2]!r}; figures: {', '.join(FIGURES)}.")
        yield _Block(match[2], document.parent / match[3], match[3], match[4])
