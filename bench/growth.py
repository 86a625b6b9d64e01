"""How do time and memory of the surrogate grow with textures, images, views and faces? At most linearly, is the mark.

python -m bench.growth [--axes texels pixels views faces] [--rounds 5] [--csv growth.csv] [--chart growth.png]

One shipped object; random pictures stand in for the target's. Prints CSV, then the exponent of each cost: the slope of
its logarithm against the logarithm of the axis, by least squares over the largest half of the sizes, where fixed costs
matter least. A chart (PNG or SVG, by its name) needs matplotlib.
"""

import argparse
import csv
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from trimesh.remesh import subdivide

from bench._common import BenchObject, bench_objects, forward_backward, machine, measured_at_random
from trompe_experiments.markdown import markdown_table
from trompe_server.surrogate import textures_of
from trompe_server.surrogate.calibration import build_surrogate
from trompe_server.system.memory import keep_freed_memory
from trompe_shared.comparison import grouped
from trompe_shared.object3d import Object3D
from trompe_shared.wavefront import Part

TEXTURE_SIDES = (256, 512, 1024, 2048, 4096)
IMAGE_SIDES = (64, 128, 224, 362, 512)
VIEWS = (6, 12, 30, 60, 120)
MOST_FACES = 1_000_000

Made = TypeVar("Made")


@dataclass(frozen=True)
class Case:
    """What is varied, its size, and how to make it."""

    axis: str
    size: int
    obj: Object3D
    views: int = 6
    side: int = 128


@dataclass(frozen=True)
class Cost:
    """Medians of some rounds: preparing (rasterise, operator, colour model) in seconds, a step (forward and backward of
    all views) in milliseconds; and the operators in MiB."""

    axis: str
    size: int
    prepare_s: float
    step_ms: float
    operator_mib: float


def cases(entry: BenchObject, axes: Sequence[str]) -> Iterator[Case]:
    """All that is measured, smallest first on each axis."""
    small = painted(entry.obj, 256)
    made: dict[str, Callable[[], Iterator[Case]]] = {
        "texels": lambda: (Case("texels", side * side, painted(entry.obj, side)) for side in TEXTURE_SIDES),
        "pixels": lambda: (Case("pixels", side * side, small, side=side) for side in IMAGE_SIDES),
        "views": lambda: (Case("views", count, small, views=count) for count in VIEWS),
        "faces": lambda: (Case("faces", n_faces(obj), obj, views=2) for obj in refinements(small)),
    }
    for axis in axes:
        yield from made[axis]()


def painted(obj: Object3D, side: int) -> Object3D:
    """``obj`` with every texture noise of side x side texels."""
    random = np.random.default_rng(0)
    return obj.with_textures({name: random.integers(0, 256, (side, side, 3), dtype=np.uint8) for name in obj.textures})


def n_faces(obj: Object3D) -> int:
    """Triangles of all parts."""
    return sum(len(part.faces) for part in obj.parts)


def refinements(obj: Object3D) -> Iterator[Object3D]:
    """``obj``, and again with each triangle cut into four, as long as it has no more than ``MOST_FACES``."""
    while n_faces(obj) <= MOST_FACES:
        yield obj
        obj = replace(obj, parts=tuple(_refined(part) for part in obj.parts))


def _refined(part: Part) -> Part:
    """Each triangle cut into four at the middles of its edges."""
    corners, faces = subdivide(np.hstack([part.vertices, part.normals, part.uvs]), part.faces)
    vertices, normals, uvs = np.split(corners, [3, 6], axis=1)
    return Part(part.material, vertices, normals, uvs, faces.astype(np.int32))


def cost(entry: BenchObject, case: Case, rounds: int) -> Cost:
    """The costs of one case."""
    views = [entry.views(azimuths=6, elevations=-(-case.views // 6))[k] for k in range(case.views)]
    size = (case.side, case.side)
    calibration, clean = measured_at_random(len(views), size, "curve")
    textures = textures_of(case.obj)
    preparing, stepping = [], []
    for _ in range(rounds):
        seconds, surrogate = timed(lambda: build_surrogate(calibration, case.obj, views, clean))
        preparing.append(seconds)
        stepping += [timed(lambda: forward_backward(surrogate, textures, torch.ones_like))[0] for _ in range(2)]  # noqa: B023
    middle = (statistics.median(preparing), 1000 * statistics.median(stepping))
    return Cost(case.axis, case.size, *middle, surrogate.geometry.nbytes / 2**20)


def timed(work: Callable[[], Made]) -> tuple[float, Made]:
    """Seconds, and what came of it."""
    started = time.perf_counter()
    made = work()
    return time.perf_counter() - started, made


def exponent(costs: Sequence[Cost], name: str) -> float:
    """How the cost called ``name`` grows over the largest half of ``costs``, which are of one axis."""
    largest = costs[len(costs) // 2 :]
    sizes, values = ([getattr(cost, attribute) for cost in largest] for attribute in ("size", name))
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def exponents(costs: Sequence[Cost]) -> str:
    """Table of the exponents; at most 1.1 counts as linear, for timings are not exact."""
    rows = []
    for axis, mine in grouped(costs, lambda each: each.axis).items():
        slopes = [exponent(mine, name) for name in LABELS]
        sizes = f"{mine[len(mine) // 2].size} .. {mine[-1].size}"
        rows.append([axis, sizes, *(f"{slope:.2f}" for slope in slopes), "yes" if max(slopes) <= 1.1 else "no"])
    return markdown_table(["exponent against", "sizes", *LABELS, "linear at most"], rows)


AXES = {
    "texels": "texture side, texels",
    "pixels": "image side, pixels",
    "views": "views",
    "faces": "triangles of the mesh",
}
LABELS = {
    "prepare_s": ("prepare all views, s", "#0072B2"),
    "step_ms": ("one step, forward\nand backward, ms", "#D55E00"),
    "operator_mib": ("memory of the\noperators, MiB", "#009E73"),
}
"""What each cost is called, and its colour (of Okabe and Ito, which the colour-blind tell apart)."""


def draw(costs: Sequence[Cost], files: Sequence[Path]) -> None:
    """A chart: a row for each cost, a column for each axis, and the exponent in each panel."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        sys.exit("A chart needs matplotlib: pip install matplotlib, or leave --chart out.")
    tables = grouped(costs, lambda each: each.axis)
    figure = Figure(figsize=(3 * len(tables), 6.4), layout="constrained")
    panels = figure.subplots(len(LABELS), len(tables), sharex="col", sharey="row", squeeze=False)
    for row, name in zip(panels, LABELS, strict=True):
        row[0].set_ylabel(LABELS[name][0])
        for panel, (axis, mine) in zip(row, tables.items(), strict=True):
            _curve(panel, axis, mine, name)
    for panel, axis in zip(panels[-1], tables, strict=True):
        panel.set_xlabel(AXES[axis])
    title = "Exponents: over the largest half of the sizes. Dotted: linear in texels, pixels, views, triangles."
    figure.suptitle(title, fontsize=9)
    for file in files:
        figure.savefig(file, dpi=120, metadata={"Date": None} if file.suffix == ".svg" else None)


def _curve(panel: Any, axis: str, costs: Sequence[Cost], name: str) -> None:
    """One cost against one axis; sides are drawn by their length, so that what is linear in texels rises by 2."""
    sizes, values = (np.array([getattr(cost, attribute) for cost in costs]) for attribute in ("size", name))
    shown, colour = np.sqrt(sizes) if "side" in AXES[axis] else sizes, LABELS[name][1]
    panel.set(xscale="log", yscale="log", xticks=shown, xticklabels=[f"{x:.0f}" for x in shown])
    panel.plot(shown, values[-1] * sizes / sizes[-1], color="0.5", linestyle=":", scaley=False)
    panel.plot(shown, values, color=colour, marker="o", markersize=5)
    panel.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    panel.tick_params(axis="x", labelrotation=30, labelsize=8)
    panel.grid(alpha=0.3)
    text = f"exponent {max(exponent(costs, name), 0):.2f}"
    panel.text(0.04, 0.95, text, transform=panel.transAxes, va="top", fontsize=9, bbox={"color": "white", "alpha": 0.8})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", choices=list(AXES), default=list(AXES))
    parser.add_argument("--object", default="teapot", metavar="NAME", help="a shipped object, or one of TROMPE_ASSETS")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--csv", type=Path, metavar="FILE")
    parser.add_argument("--chart", type=Path, nargs="+", default=[], metavar="FILE")
    options = parser.parse_args()
    keep_freed_memory()
    (entry,) = bench_objects([options.object])
    print(machine() + "\n")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    names = [field.name for field in fields(Cost)]
    writer.writerow(names)
    costs = []
    for case in cases(entry, options.axes):
        costs.append(cost(entry, case, options.rounds))
        writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in astuple(costs[-1])])
        sys.stdout.flush()
    print("\n" + exponents(costs))
    if options.csv is not None:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([names, *map(astuple, costs)])
    if options.chart:
        draw(costs, options.chart)


if __name__ == "__main__":
    main()
