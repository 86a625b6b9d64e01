"""Options of a renderer worker with any engine."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Options:
    """depth_range: metres shown as white in depth views. time_step: seconds between frames; the clock's if none."""

    depth_range: float = 10.0
    time_step: float | None = None
