"""Style of the figures: colours for the colour-blind (Okabe and Ito), SVG and PNG, the same bytes for the same data."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import BaseModel

INK: Final = "#262626"
GREY: Final = "#999999"
BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PALETTE: Final = (BLUE, ORANGE, GREEN, RED, "#CC79A7", "#56B4E9", "#F0E442", INK)
MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")
RC: Final[Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E5E5E5",
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "svg.hashsalt": "trompe",
    "svg.fonttype": "path",
}


def look(number: int) -> dict[str, Any]:
    """Colour and marker of a series; beyond the palette they begin again."""
    return {"color": PALETTE[number % len(PALETTE)], "marker": MARKERS[number % len(MARKERS)]}


class Drawing:
    """A figure with its panels, row by row."""

    def __init__(self, figure: Figure, panels: Sequence[Axes]) -> None:
        self.figure, self.panels = figure, list(panels)

    def save(self, folder: Path, name: str, *, stamp: str) -> list[Path]:
        """Write ``name``.svg and ``name``.png with ``stamp`` in their metadata; returns their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        svg, png = folder / f"{name}.svg", folder / f"{name}.png"
        with matplotlib.rc_context(RC):
            self.figure.savefig(svg, metadata={"Date": None, "Creator": "trompe", "Description": stamp})
            self.figure.savefig(png, dpi=160, metadata={"Software": "trompe", "Description": stamp})
        return [svg, png]


@contextmanager
def drawing(*, size: tuple[float, float], panels: Sequence[int] = (1,), **options: Any) -> Iterator[Drawing]:
    """A figure of ``size`` (width, height in inches) with ``panels`` in each row, which fill its width."""
    parts = math.lcm(*panels)
    places = [[f"{row}.{part * count // parts}" for part in range(parts)] for row, count in enumerate(panels)]
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=size, layout="constrained")
        yield Drawing(figure, list(figure.subplot_mosaic(places, **options).values()))  # type: ignore[arg-type]


def stamp_of(rows: Sequence[BaseModel]) -> str:
    """Name of a figure's data: a hash of its rows without job ids and unset columns."""
    digest = hashlib.sha256()
    for row in rows:
        digest.update(row.model_dump_json(exclude={"job"}, exclude_unset=True).encode())
    return f"data {digest.hexdigest()[:16]}"
