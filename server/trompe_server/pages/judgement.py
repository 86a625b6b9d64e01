"""The page of a judgement: one HTML file without a reference to any other."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any, Final

from markupsafe import Markup

from trompe_server.pages.chart import COLOURS
from trompe_server.pages.serving import STATIC, render
from trompe_shared.api import Accuracy, Cell, Manifest

LEFT, RIGHT, TOP, BOTTOM = 50.0, 700.0, 15.0, 250.0
SPREAD: Final = 8.0
"""Distance of the points of one image pipeline."""


def judgement_page(manifest: Manifest, pictures: Mapping[str, bytes]) -> str:
    """HTML of the manifest. pictures: JPEG files by title."""
    columns = [(each.renderer, each.network) for each in manifest.predictions]
    pipelines = list(dict.fromkeys(cell.pipeline for cell in manifest.cells))
    return render(
        "judgement.html",
        manifest=manifest,
        after=manifest.after.source.rsplit("/", 1)[-1],
        style=Markup((STATIC / "trompe.css").read_text()),
        figures={
            (cell.renderer, cell.network, cell.pipeline): shares_in_words(cell.accuracy) for cell in manifest.cells
        },
        columns=columns,
        pipelines=pipelines,
        marks=_marks(manifest.cells, columns, pipelines),
        ticks=[{"x": _x(number, pipelines), "text": name} for number, name in enumerate(pipelines)],
        levels=[{"y": _y(tenth / 5), "text": f"{tenth / 5:.1f}"} for tenth in range(6)],
        looks={f"{network} in {renderer}": _look(k) for k, (renderer, network) in enumerate(columns)},
        pictures={title: f"data:image/jpeg;base64,{b64encode(data).decode()}" for title, data in pictures.items()},
    )


def shares_in_words(found: Accuracy | None) -> tuple[str, str, str]:
    """Shares before and after, and the drop with its interval; the last is ``missing`` for a cell without figures."""
    if found is None:
        return "", "", "missing"
    drop, interval = found.a_drop, found.a_drop_interval
    within = "" if interval is None else f" ({interval[0]:.2f} to {interval[1]:.2f})"
    after = "" if found.a_after is None else f"{found.a_after:.2f}"
    return f"{found.a_before:.2f}", after, "n.a." if drop is None else f"{drop:.2f}{within}"


def _marks(cells: Sequence[Cell], columns: Sequence[tuple[str, str]], pipelines: Sequence[str]) -> list[dict[str, Any]]:
    """Points of the chart with their intervals, in SVG units."""
    marks = []
    for cell in cells:
        found = cell.accuracy
        if found is None or found.a_drop is None or found.a_drop_interval is None:
            continue
        column = columns.index((cell.renderer, cell.network))
        aside = (column - (len(columns) - 1) / 2) * min(SPREAD, 40 / len(columns))
        marks.append(
            {
                "x": _x(pipelines.index(cell.pipeline), pipelines) + aside,
                "y": _y(found.a_drop),
                "low": _y(found.a_drop_interval[0]),
                "high": _y(found.a_drop_interval[1]),
                "look": _look(column),
                "title": f"{cell.network} in {cell.renderer}, {cell.pipeline}: A_drop {shares_in_words(found)[2]}",
            }
        )
    return marks


def _x(number: int, pipelines: Sequence[str]) -> float:
    return round(LEFT + (number + 0.5) * (RIGHT - LEFT) / len(pipelines), 1)


def _y(drop: float) -> float:
    return round(BOTTOM - (BOTTOM - TOP) * max(0.0, min(1.0, drop)), 1)


def _look(column: int) -> str:
    return f"series-{column % COLOURS}"
