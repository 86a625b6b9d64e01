"""Whole jobs in this process, without a service: with any target, and any network in the classifier's place."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import AttackJob
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.library import Library
from trompe_server.scene import Scene, open_scene
from trompe_server.target import TargetRenderer
from trompe_shared.api import JobSpec, Result

__all__ = ["Change", "Done", "run_job"]

Change = Callable[[WhiteBoxClassifier], WhiteBoxClassifier]
"""What stands in the place of each network that is attacked."""


@dataclass(frozen=True)
class Done:
    """A job that is over: its result, what it worked on, and the repainted object's archive (``None``: no attack)."""

    result: Result
    scene: Scene
    painted: bytes | None


def run_job(spec: JobSpec, target: TargetRenderer, folder: Path, *, change: Change | None = None) -> Done:
    """One job from beginning to end. ``folder`` keeps its files; of an earlier job there, only what it measured of its
    target is used again. Raises ``TrompeError``.
    """
    library, artifacts = Library(folder / "library"), LocalArtifacts(folder / "job")
    shutil.rmtree(folder / "job", ignore_errors=True)
    scene = open_scene(spec, library=library, target=target)
    if change is not None:
        members = tuple(change(member) for member in scene.members)
        scene = replace(scene, classifier=members[0], members=members)
    job = AttackJob(spec, scene, artifacts, LocalArtifacts(folder / "calibrations"))
    for phase in job.phases():
        if job.run(phase, lambda _: None).state is not None:
            break
    result = Result.model_validate_json(artifacts.read("result.json"))
    painted = artifacts.read("adversarial.zip") if artifacts.exists("adversarial.zip") else None
    return Done(result, scene, painted)
