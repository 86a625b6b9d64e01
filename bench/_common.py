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

from trompe_server.experiments.library_objects import LibraryObject as BenchObject
from trompe_server.experiments.library_objects import loaded
from trompe_server.experiments.own_renderer import running_renderer
from trompe_shared.asset_objects import asset_objects
from trompe_shared.object3d import Object3D
from trompe_shared.shipped import shipped_objects

__all__ = [
    "BenchObject",
    "Times",
    "assets",
    "bench_objects",
    "in_rounds",
    "machine",
    "painted_at_random",
    "rescaled",
    "running_renderer",
]


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
    return [loaded(table[name]) for name in wanted]


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


def painted_at_random(
    n_views: int, size: tuple[int, int], greys: Sequence[int], generator: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Stand-ins for what a target shows, where only time counts: clean (views, H, W, 3) and probes (greys, views, H, W,
    3), each probe dimmed grey."""
    clean = generator.integers(40, 200, (n_views, *size, 3), dtype=np.uint8)
    shade = generator.uniform(0.4, 0.9, (n_views, *size, 1))
    probes = np.stack([np.broadcast_to((grey * shade).astype(np.uint8), clean.shape) for grey in greys])
    return clean, probes


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
