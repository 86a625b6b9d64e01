"""One job from object to result, cut into phases that a job engine can run, repeat and resume.

Each phase reads what it needs from the job's artifacts and writes what it made there, so that a job goes on in another
process where the last one stopped. No engine, database or clock is known here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from trompe_shared.api import JobState, Progress
from trompe_shared.errors import TrompeError

__all__ = ["VIEWS_AFTER", "VIEWS_BEFORE", "Artifacts", "DamagedFileError", "PhaseReport", "Pipeline"]

VIEWS_BEFORE, VIEWS_AFTER = "views_before", "views_after"
"""Names of the arrays (``.npz``) with all of the target's images, ``own`` and ``held_out``: (views, H, W, 3) uint8."""

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


class DamagedFileError(TrompeError):
    """A file that an earlier phase left is missing or damaged; it is there again when that phase was run again."""

    code = "damaged-file"


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
        """Run one phase. Raises ``DamagedFileError`` where the phase before must be run again first, and other kinds of
        ``TrompeError`` for what the user can mend.
        """
        ...
