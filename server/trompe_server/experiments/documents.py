"""Documents whose figures and tables come from data: blocks between two comments are written by a command.

    <!-- trompe: table_one of experiments/paper -->
    ...
    <!-- end -->

The first word is a name of ``figures.FIGURES``, the second the folder of an experiment, beside the document. The figure
is drawn into the folder, its stamp names the data, and the block holds the link and the table.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from trompe_server.experiments.figures import FIGURES, Data, read_data
from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import RESULTS

__all__ = ["fill", "out_of_step"]

BLOCK = re.compile(r"(<!-- trompe: (\w+) of (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class _Block:
    """A block of a document: which figure, of which folder."""

    figure: str
    folder: Path
    link: str

    def text(self) -> str:
        """What stands in it."""
        if not (self.folder / RESULTS).exists():
            return f"*Not measured yet: {self.link}/{RESULTS} is missing.*\n"
        data, kind = read_data(self.folder), FIGURES[self.figure]
        picture = f"![{kind.title}]({self.link}/figures/{self.figure}.svg)\n\n"
        return f"\n{picture}{kind.table(data) if kind.table else ''}\n<!-- {data.stamp} -->\n"

    def draw(self) -> None:
        """Draw the figure."""
        if (self.folder / RESULTS).exists():
            read_data(self.folder).draw(self.figure)


def fill(document: Path) -> list[str]:
    """Draw all figures that ``document`` names and write its blocks anew; gives what changed.

    Raises ``SpecError`` for a block that names no figure or a table that cannot be read.
    """
    before = document.read_text("utf-8")
    for block in _blocks(document, before):
        block.draw()
    changed = out_of_step(document)
    document.write_text(_filled(document, before), "utf-8")
    return changed


def out_of_step(document: Path) -> list[str]:
    """What in ``document`` does not fit its data: blocks whose text differs, and figures drawn from other data."""
    text, found = document.read_text("utf-8"), []
    for block, match in zip(_blocks(document, text), BLOCK.finditer(text), strict=True):
        if match[4] != block.text():
            found.append(f"{document.name}: the block {block.figure} of {block.link} is not made from its data")
        if (block.folder / RESULTS).exists() and not _in_step(block, read_data(block.folder)):
            found.append(f"{block.link}/figures/{block.figure}.svg is not made from {block.link}/{RESULTS}")
    return found


def _in_step(block: _Block, data: Data) -> bool:
    """Whether the figure says that it was made from these rows."""
    svg = block.folder / "figures" / f"{block.figure}.svg"
    return svg.exists() and data.stamp in svg.read_text("utf-8")


def _filled(document: Path, text: str) -> str:
    blocks = iter(list(_blocks(document, text)))
    return BLOCK.sub(lambda match: f"{match[1]}{next(blocks).text()}{match[5]}", text)


def _blocks(document: Path, text: str) -> Iterator[_Block]:
    for match in BLOCK.finditer(text):
        if match[2] not in FIGURES:
            raise SpecError(f"{document.name} asks for a figure {match[2]!r}; there are {', '.join(FIGURES)}.")
        yield _Block(match[2], document.parent / match[3], match[3])
