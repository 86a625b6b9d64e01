"""Named sets of options for the effort of an attack.

Measured in docs/experiments.md by ``trompe experiment run speed_accuracy``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final


@dataclass(frozen=True)
class Preset:
    """``options`` by keyword; ``help`` is one phrase."""

    help: str
    options: Mapping[str, Any]


PRESETS: Final[Mapping[str, Preset]] = {
    "fast": Preset("a first look with few random views and few steps", {"pool": 60, "steps": 25, "held_out": 30}),
    "balanced": Preset("effective on unseen cameras and lights too", {"pool": 240, "steps": 90, "held_out": 60}),
    "best": Preset("strongest attack, at any cost", {"pool": 960, "steps": 300, "held_out": 200}),
}


def with_preset(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options with ``preset`` replaced by those of the preset; the others override them.

    Raises ``ValueError`` for an unknown preset.
    """
    preset = options.get("preset")
    if preset is not None and preset not in list(PRESETS):
        raise ValueError(f"unknown preset {preset!r}; presets: {', '.join(PRESETS)}")
    others = {name: value for name, value in options.items() if name != "preset"}
    return (dict(PRESETS[preset].options) if preset else {}) | others
