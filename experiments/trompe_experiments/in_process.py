"""One job in this process, without a service: with any target, and with changed networks."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.job.protocol import number_after
from trompe_server.job.setup import JobSetup, open_setup
from trompe_server.job.texture_attack import TextureAttack
from trompe_server.library import Library
from trompe_server.renderers import TargetRenderer
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import ADVERSARIAL, JobSpec, Result

Change = Callable[[WhiteBoxClassifier], WhiteBoxClassifier]
"""Replacement of each attacked network."""


@dataclass(frozen=True)
class Done:
    """A finished job: result, setup, and the archive of the repainted object (``None`` without an attack)."""

    result: Result
    setup: JobSetup
    painted: bytes | None


def run_job(spec: JobSpec, target: TargetRenderer, folder: Path, *, change: Change | None = None) -> Done:
    """Run one job with its files in ``folder``, which must be new or empty. Raises ``TrompeError``."""
    library, artifacts = Library(folder / "library", networks=("*",)), LocalArtifacts(folder / "job")
    setup = open_setup(spec, library=library, target=target)
    if change is not None:
        members = tuple(change(member) for member in setup.members)
        setup = replace(setup, classifier=members[0], members=members)
    job = TextureAttack(spec, setup, artifacts, library.calibrations)
    phases, number = job.phases(), 0
    while number < len(phases):
        report = job.run(phases[number], lambda _: None)
        number = len(phases) if report.state is not None else number_after(report, number, phases)
    result = Result.model_validate_json(artifacts.read("result.json"))
    archive = f"{result.object}{ADVERSARIAL}.zip"
    return Done(result, setup, artifacts.read(archive) if artifacts.exists(archive) else None)
