"""Whole jobs in this process, without a service: with any target, any network in the classifier's place, any surrogate,
on any device."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import AttackJob
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.library import Library
from trompe_server.scene import Scene, open_scene
from trompe_server.surrogate import SamplingModel, Surrogate
from trompe_server.target import TargetRenderer
from trompe_shared.api import JobSpec, Result

__all__ = ["Change", "Done", "MakeSurrogate", "run_job"]

Change = Callable[[WhiteBoxClassifier], WhiteBoxClassifier]
"""What stands in the place of each network that is attacked."""
MakeSurrogate = Callable[[Scene], Surrogate]
"""What stands in the place of our surrogate renderer."""


@dataclass(frozen=True)
class Done:
    """A job that is over: its result, what it worked on, and the repainted object's archive (``None``: no attack)."""

    result: Result
    scene: Scene
    painted: bytes | None


def run_job(
    spec: JobSpec,
    target: TargetRenderer,
    folder: Path,
    *,
    change: Change | None = None,
    surrogate: MakeSurrogate | None = None,
    device: str = "cpu",
) -> Done:
    """One job from beginning to end. ``folder`` keeps its files; of an earlier job there, only what it measured of its
    target is used again. Raises ``TrompeError``.
    """
    library, artifacts = Library(folder / "library"), LocalArtifacts(folder / "job")
    shutil.rmtree(folder / "job", ignore_errors=True)
    scene = open_scene(spec, library=library, target=target, device=device)
    if change is not None:
        members = tuple(change(member) for member in scene.members)
        scene = replace(scene, classifier=members[0], members=members)
    calibrations = LocalArtifacts(folder / "calibrations")
    job = AttackJob(spec, scene, artifacts, calibrations)
    if surrogate is not None:
        job = _WithSurrogate(spec, scene, artifacts, calibrations, surrogate)
    for phase in job.phases():
        if job.run(phase, lambda _: None).state is not None:
            break
    result = Result.model_validate_json(artifacts.read("result.json"))
    painted = artifacts.read("adversarial.zip") if artifacts.exists("adversarial.zip") else None
    return Done(result, scene, painted)


class _WithSurrogate(AttackJob):
    """A job whose surrogate is made by somebody else."""

    def __init__(
        self,
        spec: JobSpec,
        scene: Scene,
        artifacts: LocalArtifacts,
        calibrations: LocalArtifacts,
        make: MakeSurrogate,
    ) -> None:
        super().__init__(spec, scene, artifacts, calibrations)
        self._make = make

    @cached_property
    def _surrogate(self) -> Surrogate:
        return self._make(self.scene)

    def _prepare_beside(self, sampling: SamplingModel) -> None:
        """Nothing: our own surrogate is not needed."""
