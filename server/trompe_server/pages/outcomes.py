"""Outcomes of ended jobs, for lists: a few figures of each result."""

import json
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from trompe_server.api.jobs import RESULT
from trompe_server.storage.folders import JobArtifacts

KEPT: Final = 2000
"""Outcomes in memory."""


@dataclass(frozen=True)
class Outcome:
    """``drop``: A_drop in the target, of held-out views if there are any (``unseen``); ``None`` without an attack."""

    drop: float | None
    unseen: bool


class Outcomes:
    """Outcomes of ended jobs by the files of the job; results never change. Thread-safe."""

    def __init__(self) -> None:
        self.of = lru_cache(maxsize=KEPT)(_outcome)


def _outcome(artifacts: JobArtifacts) -> Outcome | None:
    """The outcome, or ``None`` without a readable result."""
    try:
        result = json.loads(artifacts.read(RESULT))
    except (FileNotFoundError, ValueError):
        return None
    judged = result.get("held_out") or result.get("target") or {}
    return Outcome(judged.get("a_drop"), bool(result.get("held_out")))
