"""One job as a sequence of phases that an executor can run, repeat and resume.

Each phase reads its input from the job's artifacts and writes its output there, so another process can continue the
job. Knows no executor, database or clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from trompe_shared.api import JobState, Progress
from trompe_shared.errors import TrompeError

VIEWS_BEFORE, VIEWS_AFTER = "views_before", "views_after"
"""Names of the arrays (``.npz``) with all target images, ``own`` and ``held_out``: (views, H, W, 3) uint8."""

SAILENV = ".sailenv.zip"
"""Ending of the repainted object as SAILenv's zip, if the upload is a zip in another format."""

THUMBNAIL = "thumbnail.png"
"""Name of a small picture of one view, before on the left and after on the right."""


def numbered(name: str, renderer: int) -> str:
    """The file ``name`` of a renderer, by its number in the job: the first one's has no number."""
    return f"{name}-{renderer}" if renderer else name


OnProgress = Callable[[Progress], None]


class Artifacts(Protocol):
    """The files of one job. A write is atomic."""

    def read(self, name: str) -> bytes:
        """Content of a file. Raises ``FileNotFoundError``."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Store a file, replacing one of the same name."""
        ...

    def exists(self, name: str) -> bool:
        """Whether the file exists."""
        ...


class DamagedFileError(TrompeError):
    """A file of an earlier phase is missing or damaged. Running that phase again restores it."""

    code = "damaged-file"


@dataclass(frozen=True)
class PhaseReport:
    """Outcome of a phase, small enough for the job's record.

    state: set if the job ends with this phase (succeeded, or n.a. with the reason in ``note``). public: names of the
    artifacts for the user. counts: work of the phase, by name: ``attack_steps``, ``classifier_images`` (shown by the
    attack), ``target_renders``. then: the phase to go on with, if not the next one of the job.
    """

    progress: Progress
    state: JobState | None = None
    note: str | None = None
    public: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    then: str | None = None


def number_after(report: PhaseReport, number: int, phases: Sequence[str]) -> int:
    """Number of the phase to go on with after phase ``number``."""
    return number + 1 if report.then is None else phases.index(report.then)


class PhasedJob(Protocol):
    """The phases of one job, in order. An interrupted phase may be run again."""

    def phases(self) -> list[str]:
        """Names of the phases, e.g. ``["prepare", "calibrate", "attack-000", "attack-001", "judge"]``."""
        ...

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Run one phase.

        Raises ``DamagedFileError`` if the phase before must run again, and other kinds of ``TrompeError`` for errors
        the user can fix.
        """
        ...
