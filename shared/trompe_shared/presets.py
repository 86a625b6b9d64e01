"""Named sets of options for the effort of an attack.

Measured in docs/experiments.md by ``trompe experiment run speed_accuracy``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final


@dataclass(frozen=True)
class Preset:
    """``options`` by keyword; ``help`` is one phrase."""

    help: str
    options: Mapping[str, Any]


def _preset(help: str, **options: Any) -> Preset:
    return Preset(help, MappingProxyType(options))


PRESETS: Final[Mapping[str, Preset]] = MappingProxyType(
    {
        "fast": _preset("a first look with few random views and few steps", pool=60, steps=25, held_out=30),
        "balanced": _preset("effective on unseen cameras and lights too", pool=240, steps=90, held_out=60),
        "best": _preset("strongest attack, at any cost", pool=960, steps=300, held_out=200),
    }
)
