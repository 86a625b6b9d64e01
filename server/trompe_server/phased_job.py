"""What every kind of attack has in common as a job: looking first, attacking in chunks, judging in the target.

prepare     the target's images of the unpainted object, what the classifier says of them, its saliency
calibrate   probes, where the kind of attack needs a model of the target
attack-NNN  some steps of the attack
judge       what came out goes into the target; report
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.attack import saliency
from trompe_server.attack_report import Evidence, public_files
from trompe_server.job_files import JobFiles
from trompe_server.pipeline import VIEWS_AFTER, VIEWS_BEFORE, Artifacts, OnProgress, PhaseReport
from trompe_server.scene import Scene
from trompe_shared.api import JobSpec, JobState, Progress
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["CHUNK", "PROBE_STREAM", "Ask", "Image8", "PhasedJob"]

CHUNK: Final = 5
"""Attack steps per phase: what is lost at most when a worker dies."""

PROBE_STREAM: Final = 0
"""Keeps the random numbers of the probes apart from those of the views."""

Image8 = NDArray[np.uint8]
Ask = Callable[[Object3D, Sequence[View]], Image8]


class PhasedJob(ABC):
    """One job; see the head of this module. All that a phase leaves for later ones is in ``artifacts``.

    ``shares``: the phases by kind, and their parts of the progress bar.
    """

    shares: ClassVar[Mapping[str, float]] = {"prepare": 0.15, "calibrate": 0.25, "attack": 0.45, "judge": 0.15}

    def __init__(self, spec: JobSpec, scene: Scene, artifacts: Artifacts) -> None:
        self.spec, self.scene, self.artifacts = spec, scene, artifacts
        first = tuple(kind for kind in self.shares if kind not in {"attack", "judge"})
        self.files = JobFiles(artifacts, chunks=-(-spec.steps // CHUNK), first=first)

    def phases(self) -> list[str]:
        """See ``Pipeline.phases``."""
        return self.files.phases

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """See ``Pipeline.run``."""
        kind, _, number = phase.partition("-")
        self._running = kind, time.perf_counter()
        if kind == "attack":
            report = self._attack(int(number), on_progress)
        else:
            work = {"prepare": self._prepare, "calibrate": self._calibrate, "judge": self._judge}[kind]
            report = work(on_progress)
        self.files.note_seconds(phase, time.perf_counter() - self._running[1])
        return report

    def _prepare(self, on_progress: OnProgress) -> PhaseReport:
        scene = self.scene
        ask = self._asker("prepare", len(scene.views) + len(scene.held_out), on_progress)
        own = ask(scene.obj, scene.views)
        self.files.save(VIEWS_BEFORE, own=own, held_out=ask(scene.obj, scene.held_out))
        if scene.white_box:
            maps = saliency(own, scene.members, goal=scene.goal, scope=self.spec.saliency_scope)
            self.files.save("saliency", maps=maps.numpy().astype(np.float16))
        if (scene.classifier.predict(own).argmax(axis=1) != scene.label).all():
            return self._end_without_attack()
        return PhaseReport(self._progress("prepare", 1.0))

    def _end_without_attack(self) -> PhaseReport:
        name = self.scene.class_name(self.scene.label)
        note = (
            f"n.a.: the classifier recognises {name!r} in none of the {len(self.scene.views)} target views "
            "of the unpainted object, so there is nothing to take away. "
            "Check --label, --distance, --elevation and --background."
        )
        public = public_files(self._seen(), self.artifacts, warnings=(note,))
        return PhaseReport(self._progress("judge", 1.0), JobState.not_applicable, note, public)

    def _calibrate(self, on_progress: OnProgress) -> PhaseReport:
        """Find out about the target what the attack's model needs to know; not asked for where it needs none."""
        raise NotImplementedError(f"{type(self).__name__} has no model of the target.")

    @abstractmethod
    def _attack(self, chunk: int, on_progress: OnProgress) -> PhaseReport: ...

    @abstractmethod
    def _judge(self, on_progress: OnProgress) -> PhaseReport: ...

    def _show_judges(
        self, obj: Object3D, own: Sequence[View], held_out: Sequence[View], on_progress: OnProgress
    ) -> Ask:
        """Keep the target's images of what came out, in the views as they are now; gives what asks for more."""
        ask = self._asker("judge", len(own) + len(held_out), on_progress)
        self.files.save(VIEWS_AFTER, own=ask(obj, own), held_out=ask(obj, held_out))
        return ask

    def _report(self, evidence: Evidence) -> PhaseReport:
        """The job's end."""
        public = public_files(evidence, self.artifacts, warnings=())
        return PhaseReport(self._progress("judge", 1.0), JobState.succeeded, None, public)

    def _seen(self) -> Evidence:
        """What the report is written from as far as every kind of attack knows it: before the attack, and after."""
        kind, started = self._running
        return Evidence(
            spec=self.spec,
            scene=self.scene,
            before=self.files.load(VIEWS_BEFORE),
            after=self.files.load(VIEWS_AFTER) if kind == "judge" else None,
            maps=self.files.load("saliency")["maps"].astype(np.float32) if self.scene.white_box else None,
            spent=self.files.spent(),
            seconds=self.files.seconds() | {kind: time.perf_counter() - started},
        )

    def _asker(self, phase: str, total: int, on_progress: OnProgress) -> Ask:
        """Asks the target for images and tells how far the phase is; ``total`` images are the whole of it."""
        done = 0

        def on_frame() -> None:
            nonlocal done
            done += 1
            on_progress(self._progress(phase, min(1.0, done / total)))

        return partial(self.scene.target.render, size=self.scene.size, on_frame=on_frame)

    def _step_progress(self, step: int, *, loss: float, fooled: float) -> Progress:
        """Progress after so many steps of the attack."""
        steps = self.spec.steps
        told = {"step": step, "steps": steps, "loss": loss, "fooled": fooled}
        return self._progress("attack", step / steps).model_copy(update=told)

    def _progress(self, phase: str, share: float) -> Progress:
        """Progress of the whole job when ``share`` of ``phase`` is done."""
        done = 0.0
        for name, part in self.shares.items():
            if name == phase:
                return Progress(phase=phase, fraction=done + share * part)
            done += part
        raise KeyError(phase)
