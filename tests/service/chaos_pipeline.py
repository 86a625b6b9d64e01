"""What the workers of the failure run do: for a job of one step something short, for the others a real attack."""

from typing import Any

from trompe_server.attack_job import open_pipeline as open_attack
from trompe_server.jobs.fake import open_pipeline as open_fake
from trompe_server.pipeline import Pipeline
from trompe_shared.api import JobSpec


def open_pipeline(spec: JobSpec, **parts: Any) -> Pipeline:
    """See ``trompe_server.attack_job.open_pipeline``."""
    pipeline: Pipeline = open_fake(spec, **parts) if spec.steps == 1 else open_attack(spec, **parts)
    return pipeline
