"""Counts what a worker does: steps, images that classifiers were shown and the target rendered, and seconds."""

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from trompe_server.pipeline import OnProgress, PhaseReport, Pipeline
from trompe_server.target.protocol import TargetRenderer
from trompe_shared.api import Progress
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["Meter", "MeteredPipeline", "MeteredTarget"]


class Meter:
    """Sums by name, to be taken away now and then. Safe to use from many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sums: dict[str, float] = {}

    def add(self, **amounts: float) -> None:
        """Add to sums."""
        with self._lock:
            for name, amount in amounts.items():
                self._sums[name] = self._sums.get(name, 0.0) + amount

    def take(self) -> dict[str, float]:
        """The sums since the last time."""
        with self._lock:
            taken, self._sums = self._sums, {}
            return taken


class MeteredTarget:
    """The target renderer ``inner``, whose images are counted."""

    def __init__(self, inner: TargetRenderer, meter: Meter) -> None:
        self._inner, self._meter = inner, meter

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> NDArray[np.uint8]:
        """See ``TargetRenderer``."""
        began = time.perf_counter()
        images = self._inner.render(obj, views, size=size, on_frame=on_frame)
        self._meter.add(target_renders=len(views), target_seconds=time.perf_counter() - began)
        return images

    def close(self) -> None:
        """See ``TargetRenderer``."""
        self._inner.close()


class MeteredPipeline:
    """The pipeline ``inner``, whose attack steps are counted."""

    def __init__(self, inner: Pipeline, meter: Meter) -> None:
        self._inner, self._meter = inner, meter

    def phases(self) -> list[str]:
        """See ``Pipeline``."""
        return self._inner.phases()

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """See ``Pipeline``."""
        step, began = None, time.perf_counter()

        def count(progress: Progress) -> None:
            nonlocal step, began
            if progress.step is not None and progress.step != step:
                step, ended = progress.step, time.perf_counter()
                self._meter.add(attack_steps=1, step_seconds=ended - began)
                began = ended
            on_progress(progress)

        return self._inner.run(phase, count)
