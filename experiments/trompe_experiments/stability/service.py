"""Runs the jobs of the stability suite in this process: only there can a network be replaced."""

import tempfile
from contextlib import AbstractContextManager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from trompe_experiments.in_process import Done, run_job
from trompe_experiments.plan import CASE
from trompe_experiments.service import Service
from trompe_experiments.stability.cases import CASES, Case
from trompe_experiments.stability.disturbed_engine import disturbed_renderer
from trompe_server.classifiers.tiny import CLASSES
from trompe_server.judging.metrics import accuracy, transfer_gap
from trompe_server.renderers import TargetRenderer
from trompe_shared.api import Job, JobRequest, JobSpec, JobState, Result
from trompe_shared.errors import TrompeError
from trompe_shared.object3d import load_object

WITHOUT_IMAGES: Final[dict[str, Any]] = {
    **dict.fromkeys(("disagreement", "margin_error", "goal_reached", "ssim", "ssim_worst", "delta_e", "delta_e_95")),
    **dict.fromkeys(("max_view_change", "pixels_beyond_epsilon", "views_beyond_epsilon")),
    **{name: [] for name in ("views", "held_out_views", "fooled_as", "judges", "image_pipelines", "renderers")},
}
"""Fields of a result that were measured on images of the undisturbed target, empty."""


class DisturbedService(Service):
    """Runs each job when it is submitted. The label ``case`` names its disturbance; without one, ``target`` renders."""

    def __init__(self, target: TargetRenderer) -> None:
        self._target = target
        self._results: dict[str, Result] = {}
        self._undisturbed: dict[str, Done] = {}

    def submit(self, request: JobRequest, key: str) -> Job:
        """Run a job; returns it in its final state."""
        spec, state, error = request.spec(), JobState.succeeded, None
        try:
            self._results[key] = self._run(spec, CASES[request.labels[CASE]])
            if self._results[key].surrogate is None:
                state = JobState.not_applicable
        except TrompeError as caught:
            state, error = JobState.failed, str(caught)
        return Job(id=key, state=state, spec=spec, worker=None, created=datetime.now(UTC), error=error, note=None)

    def result(self, job: str) -> Result:
        return self._results[job]

    def classes(self, classifier: str) -> list[str] | None:
        """Class names of the shipped classifier."""
        return list(CLASSES)

    def _run(self, spec: JobSpec, case: Case) -> Result:
        if case.afterwards:
            return self._afterwards(self._without(spec), case)
        if case == Case():
            return self._without(spec).result
        with self._disturbed(case) as target:
            return _run(spec, target, case).result

    def _without(self, spec: JobSpec) -> Done:
        """The job without any disturbance; run once."""
        name = spec.model_dump_json()
        if name not in self._undisturbed:
            self._undisturbed[name] = _run(spec, self._target, Case())
        return self._undisturbed[name]

    def _afterwards(self, done: Done, case: Case) -> Result:
        """Judge the finished object under the disturbance; warnings and surrogate are those of the undisturbed job."""
        setup = done.setup
        judge = setup.classifier if case.classifier is None else case.classifier(setup.members[0])
        painted = setup.obj if done.painted is None else load_object(done.painted)
        shown = {}
        with self._disturbed(case) as target:
            for name, views in (("target", setup.views), ("held_out", setup.held_out)):
                before, after = (judge.predict(target.render(o, views, size=setup.size)) for o in (setup.obj, painted))
                shown[name] = accuracy(before, after, setup.labels)
        gap = transfer_gap(done.result.surrogate, shown["target"])
        return done.result.model_copy(update=WITHOUT_IMAGES | shown | {"transfer_gap": gap})

    def _disturbed(self, case: Case) -> AbstractContextManager[TargetRenderer]:
        return disturbed_renderer(**case.renderer) if case.renderer else nullcontext(self._target)


def _run(spec: JobSpec, target: TargetRenderer, case: Case) -> Done:
    with tempfile.TemporaryDirectory(prefix="trompe-") as folder:
        return run_job(spec, target, Path(folder), change=case.classifier)
