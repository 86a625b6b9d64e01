"""Seconds and drop to expect of a job, from earlier ones like it. No I/O."""

from collections.abc import Sequence
from statistics import median
from typing import Final

from trompe_server.pages.present import span
from trompe_server.pages.results import Outcome
from trompe_shared.api import Job, JobSpec

CLOSE: Final = 1.5
"""Largest ratio of the epsilons of jobs that are alike."""


def estimate(ended: Sequence[tuple[Job, Outcome]], *, pool: int, steps: int, epsilon: float) -> str | None:
    """Medians over the jobs among ``ended`` with this pool, these steps and about this epsilon, in words.

    ``None`` if there are none. ``ended`` are against one classifier.
    """

    def is_like(spec: JobSpec) -> bool:
        ratio = max(spec.paint.epsilon, epsilon) / max(min(spec.paint.epsilon, epsilon), 1e-6)
        effort = (spec.views.pool, spec.search.steps)
        return not spec.views.grid and effort == (pool, steps) and ratio <= CLOSE

    like = [(job, outcome.drop) for job, outcome in ended if is_like(job.attack) and outcome.drop is not None]
    took = [(job.finished - job.started).total_seconds() for job, _ in like if job.started and job.finished]
    drops = [drop for _, drop in like if drop is not None]
    if not took:
        return None
    between = f" ({min(drops):.2f} to {max(drops):.2f})" if len(drops) > 1 else ""
    jobs = "one earlier job" if len(like) == 1 else f"{len(like)} earlier jobs"
    return f"About {span(median(took))}, A_drop about {median(drops):.2f}{between}, as in {jobs} of this effort."
