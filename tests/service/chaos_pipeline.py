"""Jobs of the chaos tests: a fake job for one step, a real attack for more."""

from typing import Any

from tests.fake_job import open_job as open_fake
from trompe_server.job.protocol import PhasedJob
from trompe_server.job.texture_attack import open_job as open_attack
from trompe_shared.api import JobSpec


def open_job(spec: JobSpec, **parts: Any) -> PhasedJob:
    """Open a job, with the arguments of ``trompe_server.job.texture_attack.open_job``."""
    job: PhasedJob = open_fake(spec, **parts) if spec.search.steps == 1 else open_attack(spec, **parts)
    return job
