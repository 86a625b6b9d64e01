"""About how long an experiment will take, before it is run."""

from collections.abc import Iterable
from typing import Final

from trompe_shared.api import JobSpec

__all__ = ["estimated_seconds"]

RENDER: Final = 0.02
"""Seconds for an image of the target, in software (docs/bench/renderer.md)."""
SHOW: Final = 0.004
"""Seconds to classify an image of 128x128, forward and backward, with the shipped classifier."""
SHOW_LARGE: Final = 0.02
"""The same of 224x224 with MobileNetV2."""
OVERHEAD: Final = 3.0
"""Seconds of a job for what does not grow with its views: loading networks, searching the sampling, writing."""


def estimated_seconds(specs: Iterable[JobSpec]) -> float:
    """Seconds on two cores for all jobs, one after the other, if none ends early; good to a factor of two."""
    return sum(_one(spec) for spec in specs)


def _one(spec: JobSpec) -> float:
    views = spec.n_views
    renders = 2 * (views + spec.held_out) + (5 if spec.surrogate == "curve" else 2) * views
    show = SHOW if spec.classifier == "tiny" else SHOW_LARGE
    networks = 1 + len(spec.ensemble)
    shown = spec.steps * spec.n_views_per_step + views + 0.5 * (2 * views + spec.held_out)
    return OVERHEAD + renders * RENDER + networks * shown * show
