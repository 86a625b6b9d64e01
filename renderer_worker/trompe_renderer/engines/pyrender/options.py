"""Options of the pyrender engine."""

from dataclasses import dataclass
from typing import Annotated

from click import IntRange


@dataclass(frozen=True)
class PyrenderOptions:
    """docs/worker.md lists effects and costs. ``anisotropy``: longest footprint of texture filters, as a ratio."""

    shadows: bool = True
    shadow_map: Annotated[int, IntRange(64, 16384)] = 1024
    msaa: Annotated[int, IntRange(1, 32)] = 4
    supersample: Annotated[int, IntRange(1, 4)] = 1
    anisotropy: Annotated[int, IntRange(1, 16)] = 1
