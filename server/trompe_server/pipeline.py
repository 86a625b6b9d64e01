"""One job from object to result, cut into phases that a job engine can run, repeat and resume.

Each phase reads what it needs from the job's artifacts and writes what it made there, so that a job goes on in another
process where the last one stopped. No engine, database or clock is known here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from trompe_shared.api import JobState, Progress

__all__ = ["Artifacts", "PhaseReport", "Pipeline"]

OnProgress = Callable[[Progress], None]


class Artifacts(Protocol):
    """The files of one job. A write is whole or not at all."""

    def read(self, name: str) -> bytes:
        """Bytes of a file; raises ``FileNotFoundError``."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Store a file under ``name``, replacing one of that name at once."""
        ...

    def exists(self, name: str) -> bool:
        """Whether there is a file ``name``."""
        ...


@dataclass(frozen=True)
class PhaseReport:
    """What a phase did: small enough to be kept by the engine.

    ``state`` is set when the job ends with this phase (succeeded, or n.a. with the reason in ``note``).
    ``public`` names the artifacts that are for the user.
    """

    progress: Progress
    state: JobState | None = None
    note: str | None = None
    public: tuple[str, ...] = ()


class Pipeline(Protocol):
    """The phases of one job, in order; ``run`` may be called again for a phase that was cut off."""

    def phases(self) -> list[str]:
        """Names of the phases, e.g. ``["prepare", "calibrate", "attack-000", "attack-001", "judge"]``."""
        ...

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Run one phase. Raises ``TrompeError`` for what the user can mend."""
        ...
