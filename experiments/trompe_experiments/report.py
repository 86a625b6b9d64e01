"""An experiment as one HTML file that contains figures, tables, pictures and data."""

import base64
import html
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image
from PIL.Image import Resampling

from trompe_experiments.about import SOURCE, read_about
from trompe_experiments.figures import Data, figures_of, histogram_rows, plain_rows, read_data
from trompe_experiments.markdown import cells_of, figure_words
from trompe_experiments.table import RESULTS, SEPARATOR, ResultRow
from trompe_shared.comparison import average

PICTURES: Final = {
    "contact_sheet.png": "Before and after, view by view",
    "saliency_object.png": "Saliency on the objects",
    "difference.png": "Change of the textures",
}
SHOWN_JOBS, WIDTH, GAP = 6, 1200, 12
COLUMNS: Final = (
    *("object", "classifier", "configuration", "seed", "state", "target_a_before", "target_a_after", "target_a_drop"),
    *("surrogate_a_drop", "held_out_a_drop", "texels_altered", "ssim", "surrogate_model", "evaluations", "seconds"),
)


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and its figures from the tables in ``folder``; returns its path. Raises ``SpecError``."""
    data, source = read_data(folder), folder / SOURCE
    environment = Environment(
        loader=PackageLoader("trompe_experiments", "files"), keep_trailing_newline=True, undefined=StrictUndefined
    )
    environment.filters |= {"e": html.escape, "bold": _bold, "blocks": _blocks}
    text = environment.get_template("report.html").render(
        experiment=data.rows[0].experiment,
        facts=_facts(data.rows),
        about=read_about(folder),
        figures=[
            (kind.title, _base64(data.draw(name)[0].read_bytes()), kind.table and kind.table(data))
            for name, kind in figures_of(data).items()
        ],
        pictures=[(title, _base64(_stacked(files))) for title, files in _pictures(data)],
        failed=[f"{_named(row)}: {row.state}: {row.error}" for row in data.rows if row.error and row.state != "n.a."],
        warnings=_warnings(data.rows),
        rows=[COLUMNS, *([_cell(getattr(row, name)) for name in COLUMNS] for row in data.rows)],
        results=(RESULTS, _base64((folder / RESULTS).read_bytes())),
        source=source.read_text("utf-8") if source.exists() else None,
    )
    path = folder / "report.html"
    path.write_text(text, "utf-8")
    return path


def _facts(rows: Sequence[ResultRow]) -> list[str]:
    drop, held_out = (average(getattr(row, f"{name}_a_drop") for row in rows) for name in ("target", "held_out"))
    return [
        f"{len({row.key for row in rows})} jobs",
        f"{len({row.object for row in rows})} objects",
        f"mean target A_drop {figure_words(drop)}",
        f"on held-out views {figure_words(held_out)}",
        f"{sum({row.key: row.seconds or 0 for row in rows}.values()) / 60:.0f} min of computing",
    ]


def _pictures(data: Data) -> Iterator[tuple[str, list[Path]]]:
    """Pictures of one job of each object, by title: the jobs of the histograms."""
    keys = [row.key for row in histogram_rows(plain_rows(data))][:SHOWN_JOBS]
    for artifact, title in PICTURES.items():
        files = [file for key in dict.fromkeys(keys) if (file := data.folder / "jobs" / key / artifact).is_file()]
        if files:
            yield title, files


def _stacked(files: Sequence[Path]) -> bytes:
    """Pictures scaled to one width, one below the other, as JPEG."""
    pictures = [stored.convert("RGB") for stored in map(Image.open, files)]
    fitted = [each.resize((WIDTH, round(WIDTH * each.height / each.width)), Resampling.LANCZOS) for each in pictures]
    sheet = Image.new("RGB", (WIDTH, sum(each.height + GAP for each in fitted) - GAP), "white")
    top = 0
    for each in fitted:
        sheet.paste(each, (0, top))
        top += each.height + GAP
    buffer = io.BytesIO()
    sheet.save(buffer, "JPEG", quality=85)
    return buffer.getvalue()


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _warnings(rows: Sequence[ResultRow]) -> dict[str, list[str]]:
    """Rows by warning."""
    told: dict[str, list[str]] = {}
    for row in rows:
        for words in filter(None, row.warnings.split(SEPARATOR)):
            told.setdefault(words, []).append(_named(row))
    return told


def _named(row: ResultRow) -> str:
    return ", ".join(word for word in (row.object, row.configuration, f"seed {row.seed}") if word)


def _cell(value: object) -> str:
    if value is None:
        return "n.a."
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _blocks(markdown: str) -> Iterator[str | list[list[str]]]:
    """Paragraphs, and rows of tables, of our own ``markdown``."""
    for block in re.split(r"\n\s*\n", markdown.strip()):
        lines = block.splitlines()
        table = lines[0].startswith("|")
        yield [cells_of(line) for k, line in enumerate(lines) if k != 1] if table else block


def _bold(text: str) -> str:
    """``text`` in HTML, with its **bold** words."""
    return re.sub(r"\*\*(.*?)\*\*", r"<b>\1</b>", html.escape(text))
