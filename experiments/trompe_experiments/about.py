"""Origin of an experiment's results (``about.json``), and an estimate of its time."""

import json
import os
import platform
import shutil
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from trompe_shared.api import JobSpec

ABOUT, SOURCE = "about.json", "experiment.yaml"

RENDER: Final = 0.02
"""Seconds for an image of the target, in software (docs/bench/renderer.md)."""
SHOW: Final = 0.004
"""Seconds to classify an image of 128x128, forward and backward, with the shipped classifier."""
SHOW_LARGE: Final = 0.02
"""Seconds to classify an image of 224x224 with MobileNetV2."""
OVERHEAD: Final = 3.0
"""Seconds of a job that do not depend on its views: loading networks, finding the sampling model, writing."""


def write_about(folder: Path, command: str, *, seconds: float, source: Path | None = None) -> None:
    """Write ``about.json`` (command, time, machine, version) and a copy of the experiment's file.

    ``seconds`` of runs in the same folder are added up.
    """
    path = folder / ABOUT
    total = seconds + read_about(folder).get("seconds", 0.0)
    note = {
        "command": command,
        "finished": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "took": in_words(total),
        "seconds": round(total, 1),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "version": f"trompe {version('trompe')}",
    }
    path.write_text(json.dumps(note, indent=1) + "\n", "utf-8")
    if source is not None and source.resolve() != (folder / SOURCE).resolve():
        shutil.copyfile(source, folder / SOURCE)


def read_about(folder: Path) -> dict[str, Any]:
    """What ``write_about`` noted; nothing if the file is missing or damaged: results do not depend on it."""
    try:
        note = json.loads((folder / ABOUT).read_text("utf-8"))
    except (FileNotFoundError, ValueError):
        return {}
    return note if isinstance(note, dict) else {}


def in_words(seconds: float) -> str:
    """E.g. ``40 s``, ``12 min``, ``3.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def estimated_seconds(specs: Iterable[JobSpec]) -> float:
    """Seconds of all jobs one after the other on two cores if no attack stops early; accurate to a factor of two."""
    return sum(_seconds(spec) for spec in specs)


def _seconds(spec: JobSpec) -> float:
    views, held_out = spec.views.count, spec.views.held_out
    renders = 2 * (views + held_out) + (5 if spec.search.surrogate == "curve" else 2) * views
    show = SHOW if spec.victim.classifier == "tiny" else SHOW_LARGE
    shown = spec.search.steps * spec.views_per_step + views + 0.5 * (2 * views + held_out)
    return OVERHEAD + renders * RENDER + (1 + len(spec.victim.ensemble)) * shown * show
