"""A job without an attack, for tests of everything around it. Workers run it with ``TROMPE_PIPELINE``.

The label of the job selects its behaviour; each phase takes ``TROMPE_FAKE_SECONDS`` (0). It logs the start and end of
each phase to ``trace.txt`` in the folder of the job, if that is local, and its process to ``process``. Each phase
derives its file from the file of the phase before, so the result shows whether all phases ran, in order, on the right
input.
"""

import hashlib
import json
import os
import signal
import time
from pathlib import Path
from typing import Final

from trompe_server.job.protocol import DamagedFileError, OnProgress, PhaseReport
from trompe_server.library import Library
from trompe_server.renderers.protocol import TargetRenderer
from trompe_server.storage.folders import JobArtifacts, LocalArtifacts
from trompe_shared.api import JobSpec, JobState, Progress
from trompe_shared.errors import ObjectError, RendererError

PHASES: Final = ["prepare", "attack-000", "attack-001", "judge"]


class FakeJob:
    """Phases that end at once, unless the label makes one fail, crash or wait for the file ``go``."""

    def __init__(self, spec: JobSpec, artifacts: JobArtifacts) -> None:
        self._label, self._artifacts = str(spec.goal.label[0]), artifacts
        self._seed = f"{self._label} {spec.search.seed}"
        self._folder = artifacts.folder.folder if isinstance(artifacts.folder, LocalArtifacts) else None

    def phases(self) -> list[str]:
        """Four phases; the third one misbehaves."""
        return PHASES

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Write ``<phase>.txt``, or misbehave by the label."""
        self._log("begin", phase)
        before = self._before(phase)
        self._take_time(phase, on_progress)
        if phase == "attack-001":
            self._misbehave(on_progress)
        made = hashlib.sha256(f"{phase} {before}".encode()).hexdigest()
        self._artifacts.write(f"{phase}.txt", made.encode())
        self._log("end", phase)
        return self._report(phase, made)

    def _before(self, phase: str) -> str:
        if phase == PHASES[0]:
            return self._seed
        name = f"{PHASES[PHASES.index(phase) - 1]}.txt"
        found = self._artifacts.read(name).decode() if self._artifacts.exists(name) else ""
        if len(found) != 64:
            raise DamagedFileError(f"{name} is not what a phase wrote; run it again.")
        return found

    def _take_time(self, phase: str, on_progress: OnProgress) -> None:
        end = time.monotonic() + float(os.environ.get("TROMPE_FAKE_SECONDS", "0"))
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
        counts = {"attack_steps": 5} if phase.startswith("attack") else {"target_renders": 3}
        return PhaseReport(progress, counts=counts)

    def _progress(self, phase: str) -> Progress:
        return Progress(phase=phase, fraction=(PHASES.index(phase) + 1) / len(PHASES))

    def _log(self, what: str, phase: str) -> None:
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / "process").write_text(str(os.getpid()))
            with (self._folder / "trace.txt").open("a") as file:
                file.write(f"{what} {phase}\n")


def open_job(
    spec: JobSpec, *, library: Library, artifacts: JobArtifacts, target: TargetRenderer, **_: object
) -> FakeJob:
    """A fake job. The label "no object" cannot be opened."""
    if spec.goal.label == ["no object"]:
        raise ObjectError("The object went away.")
    return FakeJob(spec, artifacts)


def trace(folder: Path) -> list[str]:
    """The log of the phases of a job."""
    file = folder / "trace.txt"
    return file.read_text().splitlines() if file.exists() else []
