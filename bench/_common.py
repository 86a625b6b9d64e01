"""What the benches share: the objects, a renderer to compare with, rounds of timing."""

import gc
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from trompe_experiments.asset_objects import AssetObject, asset_objects
from trompe_server.attack import grid_views
from trompe_server.surrogate import SamplingModel, Surrogate
from trompe_server.surrogate.calibration import CALIBRATED_GREYS, CURVE_GREYS, Calibration
from trompe_server.surrogate.fidelity import Fidelity
from trompe_shared.colours import COLOURS
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import ShippedObject, shipped_objects

GREYS = {"calibrated": CALIBRATED_GREYS, "curve": CURVE_GREYS}
"""What the target is asked for: `auto` takes the first for all of the paper's objects; the second costs the most."""


@dataclass(frozen=True)
class BenchObject:
    """An object, the camera's distance (metres), its range of elevations (degrees), and the background (sRGB)."""

    name: str
    obj: Object3D
    distance: float
    elevation: tuple[float, float]
    background: tuple[int, int, int]

    def views(self, *, azimuths: int = 6, elevations: int = 10) -> list[View]:
        """The paper's grid of views."""
        return grid_views(
            distance=self.distance,
            elevation=self.elevation,
            azimuths=azimuths,
            elevations=elevations,
            background=self.background,
        )


def assets() -> Path | None:
    """The folder of the real objects and classifiers, by the environment variable TROMPE_ASSETS."""
    return Path(os.environ["TROMPE_ASSETS"]) if "TROMPE_ASSETS" in os.environ else None


def bench_objects(names: Sequence[str] = ()) -> list[BenchObject]:
    """The objects called ``names``, by default the paper's ten, or the shipped ones without TROMPE_ASSETS."""
    folder = assets()
    paper = {} if folder is None else asset_objects(folder)
    table = shipped_objects() | paper
    wanted = names or list(paper or table)
    unknown = sorted(set(wanted) - set(table))
    if unknown:
        sys.exit(f"There is no object {', '.join(unknown)}; there are {', '.join(table)}. Is TROMPE_ASSETS set?")
    return [_loaded(table[name]) for name in wanted]


def _loaded(each: ShippedObject | AssetObject) -> BenchObject:
    background = COLOURS[each.background if isinstance(each, AssetObject) else "white"]
    return BenchObject(each.name, load_object(each.path), each.distance, each.elevation, background)


def rescaled(obj: Object3D, factor: float) -> Object3D:
    """``obj`` with every albedo texture resized by ``factor`` (the paper used 0.33)."""
    return obj.with_textures(
        {
            name: np.asarray(
                Image.fromarray(image).resize(
                    [round(factor * side) for side in image.shape[1::-1]], Image.Resampling.BOX
                )
            )
            for name, image in obj.textures.items()
        }
    )


def measured_at_random(n_views: int, size: tuple[int, int], model: str) -> tuple[Calibration, NDArray[np.uint8]]:
    """Stand-ins for what a target shows, where only time counts: a calibration whose probes are dimmed grey, and clean
    images (views, H, W, 3)."""
    generator, greys = np.random.default_rng(0), GREYS[model]
    clean = generator.integers(40, 200, (n_views, *size, 3), dtype=np.uint8)
    shade = generator.uniform(0.4, 0.9, (n_views, *size, 1))
    probes = np.stack([np.broadcast_to((grey * shade).astype(np.uint8), clean.shape) for grey in greys])
    nothing = Fidelity((), (), (), ())
    return Calibration(model, "for time alone", SamplingModel(), greys, probes, nothing, 0), clean


def forward_backward(
    surrogate: Surrogate, textures: Mapping[str, Tensor], gradient: Callable[[Tensor], Tensor]
) -> None:
    """One step's work of the surrogate: textures to images of all views, and back from each batch's ``gradient``."""
    leaves = {name: texture.detach().requires_grad_() for name, texture in textures.items()}
    texels = surrogate.texels(leaves)
    collected = texels.detach().requires_grad_()
    for batch in range(len(surrogate.batches)):
        images = surrogate.render(collected, batch)
        images.backward(gradient(images))  # type: ignore[no-untyped-call]
    torch.autograd.grad(texels, list(leaves.values()), collected.grad)


@dataclass(frozen=True)
class Times:
    """Seconds of each round of one contender."""

    rounds: tuple[float, ...]

    @property
    def median(self) -> float:
        """The middle one."""
        return statistics.median(self.rounds)

    @property
    def best(self) -> float:
        """The least disturbed one."""
        return min(self.rounds)

    def per(self, count: int) -> str:
        """Median and least milliseconds for one of ``count``."""
        return f"{1000 * self.median / count:.2f} / {1000 * self.best / count:.2f}"


def in_rounds(contenders: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, Times]:
    """Time all contenders ``rounds`` times in turn, after one turn that does not count.

    On a machine that others use too, each meets the same weather this way.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):
        for name, contender in contenders.items():
            gc.collect()
            started = time.perf_counter()
            contender()
            seconds[name].append(time.perf_counter() - started)
    return {name: Times(tuple(values[1:])) for name, values in seconds.items()}


def machine() -> str:
    """One line on what the figures were measured with."""
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return (
        f"{platform.machine()}, {os.cpu_count()} cores ({torch.get_num_threads()} threads used), load {load}; "
        f"Python {platform.python_version()}, torch {torch.__version__}"
    )
