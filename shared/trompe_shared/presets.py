"""Named sets of options for those who do not want to choose: how fast, or how good, an attack shall be.

The figures that justify them: docs/experiments.md, made by ``trompe experiment run speed_accuracy``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

__all__ = ["PRESETS", "Preset"]


@dataclass(frozen=True)
class Preset:
    """``options`` are fields of ``JobSpec``; ``help`` says in a line what one gets for them."""

    help: str
    options: Mapping[str, Any]


def _preset(help: str, **options: Any) -> Preset:
    return Preset(help, MappingProxyType(options))


PRESETS: Final[Mapping[str, Preset]] = MappingProxyType(
    {
        "fast": _preset("a first look: few random views, few steps", pool=60, steps=25, held_out=30),
        "balanced": _preset("holds from unseen places too", pool=240, steps=90, held_out=60),
        "best": _preset("for the strongest object, whatever it takes", pool=960, steps=300, held_out=200),
    }
)
