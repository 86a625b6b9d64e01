"""A pipeline without an attack, for tests of everything around it; ``TROMPE_PIPELINE`` makes a worker use it.

What it does is asked for by the job's label; it notes each beginning and end of a phase in ``trace.txt`` in the folder
of the job, where that is on this machine. Each phase makes its file of what the phase before made, so that the result
shows whether all of them were run, in order, each on what the one before had left.
"""

import hashlib
import json
import os
import signal
import time
from pathlib import Path
from typing import Final

from trompe_server.artifacts import JobArtifacts, LocalArtifacts
from trompe_server.library import Library
from trompe_server.meter import Meter
from trompe_server.pipeline import DamagedFileError, OnProgress, PhaseReport
from trompe_server.target.protocol import TargetRenderer
from trompe_shared.api import JobSpec, JobState, Progress
from trompe_shared.errors import ObjectError, RendererError

__all__ = ["PHASES", "FakePipeline", "open_pipeline", "trace"]

PHASES: Final = ["prepare", "attack-000", "attack-001", "judge"]
DAWDLE: Final = "TROMPE_FAKE_SECONDS"
"""Environment variable: seconds that each phase takes. Default: none."""


class FakePipeline:
    """Phases that end at once, except that the label makes one of them fail, crash or wait for the file ``go``."""

    def __init__(self, spec: JobSpec, artifacts: JobArtifacts) -> None:
        self._label, self._artifacts = str(spec.label), artifacts
        self._seed = f"{spec.label} {spec.seed}"
        self._folder = artifacts.folder.folder if isinstance(artifacts.folder, LocalArtifacts) else None

    def phases(self) -> list[str]:
        """Four phases; it is the third that misbehaves."""
        return PHASES

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Write ``<phase>.txt``, unless the label wants something else."""
        self._note("begin", phase)
        before = self._before(phase)
        self._dawdle(phase, on_progress)
        if phase == "attack-001":
            self._misbehave(on_progress)
        made = hashlib.sha256(f"{phase} {before}".encode()).hexdigest()
        self._artifacts.write(f"{phase}.txt", made.encode())
        self._note("end", phase)
        return self._report(phase, made)

    def _before(self, phase: str) -> str:
        """What the phase before made."""
        if phase == PHASES[0]:
            return self._seed
        name = f"{PHASES[PHASES.index(phase) - 1]}.txt"
        found = self._artifacts.read(name).decode() if self._artifacts.exists(name) else ""
        if len(found) != 64:
            raise DamagedFileError(f"{name} is not what a phase wrote; run it again.")
        return found

    def _dawdle(self, phase: str, on_progress: OnProgress) -> None:
        end = time.monotonic() + float(os.environ.get(DAWDLE, "0"))
        while time.monotonic() < end:
            on_progress(self._progress(phase))
            time.sleep(0.02)

    def _misbehave(self, on_progress: OnProgress) -> None:
        match self._label:
            case "broken":
                raise ObjectError("The object is broken; mend it.")
            case "bug":
                raise ZeroDivisionError("a mistake of ours")
            case "deadly":
                os.kill(os.getpid(), signal.SIGKILL)
            case "flaky renderer" if self._folder and trace(self._folder).count("begin attack-001") == 1:
                raise RendererError("The renderer went away.")
            case "gate":
                while not self._artifacts.exists("go"):
                    on_progress(Progress(phase="attack-001", fraction=0.5, step=1, steps=2))
                    time.sleep(0.02)
            case "silent":
                time.sleep(3600)

    def _report(self, phase: str, made: str) -> PhaseReport:
        progress = self._progress(phase)
        if self._label == "hopeless" and phase == "prepare":
            return PhaseReport(progress, state=JobState.not_applicable, note="no view was recognised")
        if phase == "judge":
            self._artifacts.write("result.json", json.dumps({"fake": made}).encode())
            return PhaseReport(progress, state=JobState.succeeded, public=("result.json", "judge.txt"))
        return PhaseReport(progress)

    def _progress(self, phase: str) -> Progress:
        return Progress(phase=phase, fraction=(PHASES.index(phase) + 1) / len(PHASES))

    def _note(self, what: str, phase: str) -> None:
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            with (self._folder / "trace.txt").open("a") as file:
                file.write(f"{what} {phase}\n")


def open_pipeline(
    spec: JobSpec, *, library: Library, artifacts: JobArtifacts, target: TargetRenderer, device: str, meter: Meter
) -> FakePipeline:
    """A fake pipeline that behaves as the job's label says; "no object" cannot be opened."""
    if spec.label == "no object":
        raise ObjectError("The object went away.")
    return FakePipeline(spec, artifacts)


def trace(folder: Path) -> list[str]:
    """What the phases of a job noted, in order."""
    file = folder / "trace.txt"
    return file.read_text().splitlines() if file.exists() else []
