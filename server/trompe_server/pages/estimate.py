"""Seconds and drop to expect of a job, from earlier ones like it. No I/O."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

from trompe_server.pages.present import span
from trompe_server.pages.results import Outcome
from trompe_shared.api import Job

CLOSE: Final = 1.5
"""Largest ratio of the epsilons of jobs that are alike."""


@dataclass(frozen=True)
class Effort:
    """Options that decide the time and the drop of a job against one classifier."""

    pool: int
    steps: int
    epsilon: float

    def is_like(self, job: Job) -> bool:
        """Whether ``job`` has the same views and steps, and about the same epsilon."""
        spec = job.attack
        ratio = max(spec.paint.epsilon, self.epsilon) / max(min(spec.paint.epsilon, self.epsilon), 1e-6)
        return (spec.views.pool, spec.search.steps) == (self.pool, self.steps) and ratio <= CLOSE


def estimate(effort: Effort, ended: Sequence[tuple[Job, Outcome]]) -> str | None:
    """Medians over the jobs among ``ended`` that are like ``effort``, in words; ``None`` if there are none."""
    like = [(job, outcome.drop) for job, outcome in ended if effort.is_like(job) and outcome.drop is not None]
    took = [(job.finished - job.started).total_seconds() for job, _ in like if job.started and job.finished]
    drops = [drop for _, drop in like if drop is not None]
    if not took:
        return None
    between = f" ({min(drops):.2f} to {max(drops):.2f})" if len(drops) > 1 else ""
    jobs = "one earlier job" if len(like) == 1 else f"{len(like)} earlier jobs"
    return f"About {span(median(took))}, A_drop about {median(drops):.2f}{between}, as in {jobs} of this effort."
