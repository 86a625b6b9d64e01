"""A pipeline without an attack, for tests of everything around it; ``TROMPE_PIPELINE`` makes a worker use it.

What it does is asked for by the job's label; it notes each beginning and end of a phase in ``trace.txt``.
"""

import os
import signal
import time
from pathlib import Path
from typing import Final

from trompe_server.artifacts import LocalArtifacts
from trompe_server.library import Library
from trompe_server.pipeline import OnProgress, PhaseReport
from trompe_server.target.protocol import TargetRenderer
from trompe_shared.api import JobSpec, JobState, Progress
from trompe_shared.errors import ObjectError, RendererError

__all__ = ["PHASES", "FakePipeline", "open_pipeline", "trace"]

PHASES: Final = ["prepare", "attack-000", "attack-001", "judge"]


class FakePipeline:
    """Phases that end at once, except that the label makes one of them fail, crash or wait for the file ``go``."""

    def __init__(self, label: str, artifacts: LocalArtifacts) -> None:
        self._label, self._artifacts = label, artifacts

    def phases(self) -> list[str]:
        """Four phases; it is the third that misbehaves."""
        return PHASES

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Write ``<phase>.txt``, unless the label wants something else."""
        self._note("begin", phase)
        if phase == "attack-001":
            self._misbehave(on_progress)
        self._artifacts.write(f"{phase}.txt", phase.encode())
        self._note("end", phase)
        return self._report(phase)

    def _misbehave(self, on_progress: OnProgress) -> None:
        match self._label:
            case "broken":
                raise ObjectError("The object is broken; mend it.")
            case "bug":
                raise ZeroDivisionError("a mistake of ours")
            case "deadly":
                os.kill(os.getpid(), signal.SIGKILL)
            case "flaky renderer" if trace(self._artifacts.folder).count("begin attack-001") == 1:
                raise RendererError("The renderer went away.")
            case "gate":
                while not self._artifacts.exists("go"):
                    on_progress(Progress(phase="attack-001", fraction=0.5, step=1, steps=2))
                    time.sleep(0.02)
            case "silent":
                time.sleep(3600)

    def _report(self, phase: str) -> PhaseReport:
        progress = Progress(phase=phase, fraction=(PHASES.index(phase) + 1) / len(PHASES))
        if self._label == "hopeless" and phase == "prepare":
            return PhaseReport(progress, state=JobState.not_applicable, note="no view was recognised")
        if phase == "judge":
            self._artifacts.write("result.json", b'{"fake": true}')
            return PhaseReport(progress, state=JobState.succeeded, public=("result.json", "judge.txt"))
        return PhaseReport(progress)

    def _note(self, what: str, phase: str) -> None:
        self._artifacts.folder.mkdir(parents=True, exist_ok=True)
        with (self._artifacts.folder / "trace.txt").open("a") as file:
            file.write(f"{what} {phase}\n")


def open_pipeline(
    spec: JobSpec, *, library: Library, artifacts: LocalArtifacts, target: TargetRenderer, device: str
) -> FakePipeline:
    """A fake pipeline that behaves as the job's label says; "no object" cannot be opened."""
    if spec.label == "no object":
        raise ObjectError("The object went away.")
    return FakePipeline(str(spec.label), artifacts)


def trace(folder: Path) -> list[str]:
    """What the phases of a job noted, in order."""
    file = folder / "trace.txt"
    return file.read_text().splitlines() if file.exists() else []
