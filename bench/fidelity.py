"""How well does the surrogate predict the target? All views, and a repaint that the calibration has not seen.

python -m bench.fidelity [--objects candle toilet] [--size 224] [--model curve] [--csv fidelity.csv]

The paper's ten objects from TROMPE_ASSETS/objects, or the shipped ones. For a quick look: --azimuths 2 --elevations 2.
"""

import argparse
import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench._common import BenchObject, bench_objects, machine, running_renderer
from trompe_server.markdown import markdown_row, markdown_table
from trompe_server.surrogate import SamplingModel
from trompe_server.surrogate.calibration import Calibration, build_surrogate, calibrate, painted_noise
from trompe_server.surrogate.fidelity import measure_fidelity
from trompe_server.target import SailenvTarget
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

CALIBRATION_STREAM, FRESH_STREAM = 0, 9
"""The repaint that judges is drawn from another stream of random numbers than the calibration's."""

Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Row:
    """The result for one object: means over its views, and the worst view's. ``error`` is in 1/255."""

    object: str
    views: int
    correlation: float
    slope: float
    error: float
    explained: float
    worst_correlation: float
    worst_error: float
    model: str
    sampling: str
    probe_renders: int
    seconds: float
    rendering: float

    def cells(self) -> list[str]:
        """As the columns of ``HEADER``."""
        return [
            self.object,
            f"{self.correlation:.3f}",
            f"{self.slope:.3f}",
            f"{self.error:.2f}",
            f"{self.explained:.3f}",
            f"{self.worst_correlation:.3f} / {self.worst_error:.2f}",
            self.model,
            self.sampling,
            str(self.probe_renders),
            f"{self.seconds:.1f} ({self.rendering:.1f})",
        ]


HEADER = (
    "object",
    "correlation",
    "slope",
    "error, 1/255",
    "explained",
    "worst view: correlation / error",
    "model",
    "sampling",
    "probe renders",
    "seconds (of which rendering)",
)


class Clock:
    """Asks the target and adds up the seconds it takes."""

    def __init__(self, target: SailenvTarget, size: int) -> None:
        self.target, self.size, self.seconds = target, size, 0.0

    def ask(self, obj: Object3D, views: Sequence[View]) -> Image8:
        """Images of ``obj``, (views, H, W, 3)."""
        started = time.perf_counter()
        images = self.target.render(obj, views, size=(self.size, self.size))
        self.seconds += time.perf_counter() - started
        return images


def measure(entry: BenchObject, views: Sequence[View], clock: Clock, *, model: str, seed: int) -> Row:
    """Calibrate on one repaint, judge on another."""
    clean = clock.ask(entry.obj, views)
    clock.seconds, started = 0.0, time.perf_counter()
    generator = np.random.default_rng([seed, CALIBRATION_STREAM])
    found = calibrate(entry.obj, views, clean, clock.ask, wanted=model, generator=generator)  # type: ignore[arg-type]
    surrogate = build_surrogate(found, entry.obj, views, clean)
    seconds, rendering = time.perf_counter() - started, clock.seconds
    repainted = painted_noise(entry.obj, np.random.default_rng([seed, FRESH_STREAM]))
    seen = measure_fidelity(surrogate, entry.obj, clean, repainted, clock.ask(repainted, views))
    mean = seen.mean()
    return Row(
        entry.name,
        len(views),
        mean["correlation"],
        mean["slope"],
        255 * mean["error"],
        mean["explained"],
        min(seen.correlation),
        255 * max(seen.error),
        found.model,
        described(found),
        found.renders,
        seconds,
        rendering,
    )


def described(found: Calibration) -> str:
    """The members of the sampling model that differ from the default."""
    usual = asdict(SamplingModel())
    members = [f"{name}={value}" for name, value in asdict(found.sampling).items() if value != usual[name]]
    return " ".join(members) or "default"


def marks(rows: Sequence[Row]) -> str:
    """What has to be shown on ten objects, in shares of the objects measured."""
    most = -(-len(rows) * 8 // 10)
    tests: list[tuple[str, int, Callable[[Row], bool]]] = [
        ("correlation >= 0.98 and slope 0.97..1.03", most, lambda r: r.correlation >= 0.98 and 0.97 <= r.slope <= 1.03),
        (
            "correlation >= 0.95 and slope 0.93..1.07",
            len(rows),
            lambda r: r.correlation >= 0.95 and 0.93 <= r.slope <= 1.07,
        ),
        ("error <= 1/255", most, lambda r: r.error <= 1),
        ("error <= 2/255", len(rows), lambda r: r.error <= 2),
    ]
    table = []
    for what, wanted, test in tests:
        met = sum(test(row) for row in rows)
        missing = ", ".join(row.object for row in rows if not test(row))
        table.append([what, f"{wanted} of {len(rows)}", met, "yes" if met >= wanted else "no", missing or "-"])
    return markdown_table(["mark", "wanted on", "met on", "met", "missed by"], table)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line per object."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])), lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--size", type=int, default=224, help="side of the images, pixels")
    parser.add_argument("--model", choices=["auto", "diffuse", "calibrated", "curve"], default="curve")
    parser.add_argument("--azimuths", type=int, default=6)
    parser.add_argument("--elevations", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--csv", type=Path, metavar="FILE")
    options = parser.parse_args()
    rows = []
    print(f"{machine()}; {options.azimuths} x {options.elevations} views at {options.size}x{options.size}\n")
    print(markdown_table(HEADER, []), flush=True)
    with running_renderer() as target:
        for entry in bench_objects(options.objects):
            views = entry.views(azimuths=options.azimuths, elevations=options.elevations)
            clock = Clock(target, options.size)
            rows.append(measure(entry, views, clock, model=options.model, seed=options.seed))
            print(markdown_row(rows[-1].cells()), flush=True)
    print("\n" + marks(rows))
    if options.csv is not None:
        write_csv(options.csv, rows)


if __name__ == "__main__":
    main()
