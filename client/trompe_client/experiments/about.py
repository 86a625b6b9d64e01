"""How an experiment came about: written beside its tables, read by the report."""

import json
import os
import platform
import shutil
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from trompe_client.experiments.progress import in_words

__all__ = ["ABOUT", "note_how_it_was_made"]

ABOUT, SOURCE = "about.json", "experiment.yaml"


def note_how_it_was_made(folder: Path, command: str, *, seconds: float, source: Path | None = None) -> None:
    """Write ``about.json``, and a copy of the experiment's file. The machine is the one that the command ran on.

    Runs of the same folder are added up, so that ``seconds`` is what all of it took.
    """
    path = folder / ABOUT
    before = json.loads(path.read_text("utf-8")).get("seconds", 0.0) if path.exists() else 0.0
    total = before + seconds
    note = {
        "command": command,
        "finished": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "took": in_words(total),
        "seconds": round(total, 1),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "version": f"trompe {version('trompe')}",
    }
    path.write_text(json.dumps(note, indent=1) + "\n", "utf-8")
    if source is not None:
        shutil.copyfile(source, folder / SOURCE)
