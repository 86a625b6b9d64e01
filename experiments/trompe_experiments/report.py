"""An experiment as one HTML file that contains figures, tables, pictures and data."""

import base64
import html
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from PIL import Image
from PIL.Image import Resampling

from trompe_experiments.about import ABOUT, SOURCE
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
STYLE: Final = """
body{font:15px/1.5 system-ui,sans-serif;color:#262626;max-width:1180px;margin:2rem auto;padding:0 1rem}
h1{margin-bottom:0}h2{margin-top:2.2rem;border-bottom:1px solid #ddd}img{max-width:100%;height:auto}
table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums;display:block;overflow-x:auto}
th,td{padding:.25rem .6rem;border-bottom:1px solid #e5e5e5;text-align:right;vertical-align:top}
th{position:sticky;top:0;background:#fff}td:first-child,th:first-child,td.t,th.t{text-align:left}
.facts{color:#555}.bad{color:#a33600}details{margin:.6rem 0}summary{cursor:pointer}
a:focus,summary:focus{outline:2px solid #0072B2}
"""


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and its figures from the tables in ``folder``; returns its path. Raises ``SpecError``."""
    data = read_data(folder)
    parts = [
        _head(data),
        *_figures(data),
        *_pictures(data),
        _failed(data),
        _warnings(data),
        _table(data),
        _source(data),
    ]
    path = folder / "report.html"
    path.write_text(_page(data.rows[0].experiment, "\n".join(part for part in parts if part)), "utf-8")
    return path


def _page(title: str, body: str) -> str:
    name = html.escape(title)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{name}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>\n'
        f"<body>{body}</body></html>\n"
    )


def _head(data: Data) -> str:
    rows = data.rows
    drop, held_out = (average(getattr(row, f"{name}_a_drop") for row in rows) for name in ("target", "held_out"))
    facts = [f"{len({row.key for row in rows})} jobs", f"{len({row.object for row in rows})} objects"]
    facts.append(f"mean target A_drop {figure_words(drop)}")
    facts.append(f"on held-out views {figure_words(held_out)}")
    facts.append(f"{sum({row.key: row.seconds or 0 for row in rows}.values()) / 60:.0f} min of computing")
    path = data.folder / ABOUT
    about: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() else {}
    lines = "".join(f'<p class="facts">{html.escape(f"{k}: {v}")}</p>' for k, v in about.items() if v)
    return f"<h1>{html.escape(rows[0].experiment)}</h1><p>{', '.join(facts)}.</p>{lines}"


def _figures(data: Data) -> list[str]:
    sections = []
    for name, kind in figures_of(data).items():
        svg, _ = data.draw(name)
        image = _embedded(svg.read_bytes(), "image/svg+xml", kind.title)
        table = f"<details><summary>as a table</summary>{_html_table(kind.table(data))}</details>" if kind.table else ""
        sections.append(f"<h2>{html.escape(kind.title)}</h2>{image}{table}")
    return sections


def _pictures(data: Data) -> list[str]:
    """Pictures of one job of each object: the jobs of the histograms."""
    keys = [row.key for row in histogram_rows(plain_rows(data))][:SHOWN_JOBS]
    sections = []
    for artifact, title in PICTURES.items():
        files = [file for key in dict.fromkeys(keys) if (file := data.folder / "jobs" / key / artifact).is_file()]
        if files:
            sections.append(f"<h2>{title}</h2>{_embedded(_stacked(files), 'image/jpeg', title)}")
    return sections


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


def _embedded(data: bytes, kind: str, alt: str) -> str:
    return f'<img alt="{html.escape(alt)}" src="data:{kind};base64,{base64.b64encode(data).decode()}">'


def _failed(data: Data) -> str:
    bad = [row for row in data.rows if row.error and row.state != "n.a."]
    if not bad:
        return ""
    items = "".join(f'<li class="bad">{html.escape(f"{_named(row)}: {row.state}: {row.error}")}</li>' for row in bad)
    return f"<h2>Failed</h2><ul>{items}</ul>"


def _warnings(data: Data) -> str:
    told: dict[str, list[str]] = {}
    for row in data.rows:
        for words in filter(None, row.warnings.split(SEPARATOR)):
            told.setdefault(words, []).append(_named(row))
    items = "".join(
        f"<li>{html.escape(words)} <span class='facts'>({html.escape(names[0])}"
        f"{f' and {len(names) - 1} more' if len(names) > 1 else ''})</span></li>"
        for words, names in told.items()
    )
    count = f"{len(told)} different warnings"
    return f"<h2>Warnings</h2><details open><summary>{count}</summary><ul>{items}</ul></details>" if told else ""


def _named(row: ResultRow) -> str:
    return ", ".join(word for word in (row.object, row.configuration, f"seed {row.seed}") if word)


def _table(data: Data) -> str:
    lines = [[_cell(getattr(row, name)) for name in COLUMNS] for row in data.rows]
    return f"<h2>All rows</h2><details><summary>{len(lines)} rows</summary>{_rows_in_html([COLUMNS, *lines])}</details>"


def _cell(value: object) -> str:
    if value is None:
        return "n.a."
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _source(data: Data) -> str:
    table = base64.b64encode((data.folder / RESULTS).read_bytes()).decode()
    link = f'<a download="{RESULTS}" href="data:text/csv;base64,{table}">{RESULTS}</a>'
    yaml = data.folder / SOURCE
    source = f"<pre>{html.escape(yaml.read_text('utf-8'))}</pre>" if yaml.exists() else ""
    return f"<h2>Data</h2><p>All columns: {link}</p>{source}"


def _html_table(markdown: str) -> str:
    """Our own ``markdown`` (tables, bold, paragraphs) as HTML."""
    parts: list[str] = []
    for block in re.split(r"\n\s*\n", markdown.strip()):
        lines = block.splitlines()
        if not lines[0].startswith("|"):
            parts.append(f"<p>{_bold(block)}</p>")
            continue
        parts.append(_rows_in_html([cells_of(line) for k, line in enumerate(lines) if k != 1]))
    return "".join(parts)


def _rows_in_html(rows: Sequence[Sequence[str]]) -> str:
    """A table of ``rows``, of which the first is its head."""
    tags = ["th", *["td"] * (len(rows) - 1)]
    lines = ("".join(f"<{t}>{_bold(cell)}</{t}>" for cell in row) for t, row in zip(tags, rows, strict=True))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def _bold(text: str) -> str:
    return re.sub(r"\*\*(.*?)\*\*", r"<b>\1</b>", html.escape(text))
