"""Suites: whole jobs on the library itself, without a service, where something is not as a job's options can say.

A suite can be stopped and started again: its rows are written as they come, and what is there is not run again.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from trompe_server.attack.metrics import accuracy
from trompe_server.experiments.groups import grouped
from trompe_server.experiments.in_process import Change, Done, MakeSurrogate, run_job
from trompe_server.experiments.own_renderer import running_renderer
from trompe_server.target import TargetRenderer
from trompe_shared.api import JobSpec, JobState
from trompe_shared.errors import TrompeError
from trompe_shared.experiment_table import RESULTS, ResultRow, RowId, job_key, read_table, write_table
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["Case", "OnRow", "Planned", "plan_jobs", "run_planned"]

OnRow = Callable[[ResultRow, int, int], None]
"""Told each new row, how many of those wanted there are, and how many there will be."""


@dataclass(frozen=True)
class Case:
    """How a job is run.

    options: fields of the job. target: what stands in the place of the renderer. renderer: a renderer worker of its
    own. classifier: what stands in the place of the network. surrogate: what stands in the place of our surrogate
    renderer. device, threads: what torch computes on, and with how many (by default as many as it has). afterwards: all
    this is met by the finished object of a job that was run without it.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    target: Callable[[TargetRenderer], TargetRenderer] | None = None
    renderer: Callable[[], AbstractContextManager[TargetRenderer]] | None = None
    classifier: Change | None = None
    surrogate: MakeSurrogate | None = None
    device: str = "cpu"
    threads: int | None = None
    afterwards: bool = False

    @property
    def plain(self) -> bool:
        """Whether it is a job like any other."""
        return self == Case(options=self.options)


@dataclass(frozen=True)
class Planned:
    """A row that is to be: where it belongs, how its job is run, and the job."""

    place: RowId
    case: Case
    spec: JobSpec


def plan_jobs(
    place: RowId,
    case: Case,
    options: Mapping[str, Any],
    *,
    objects: Sequence[str],
    seeds: Sequence[int],
    same: str = "",
) -> list[Planned]:
    """``case`` on shipped objects, with ``options`` of all jobs; ``place`` lacks its key.

    Rows have the same key, and share a job, when they ask the same in cases that are called the ``same`` (by default
    what the place is called).
    """
    found = []
    for name in objects:
        for seed in seeds:
            fields = {**options, **case.options, "object": name, "label": shipped_objects()[name].label, "seed": seed}
            spec = JobSpec.model_validate(fields)
            key = job_key(place.experiment, spec, same or place.configuration)
            found.append(Planned(place.model_copy(update={"key": key}), case, spec))
    return found


def run_planned(
    out: Path,
    planned: Sequence[Planned],
    *,
    wanted: Callable[[Planned], bool] = lambda _: True,
    on_row: OnRow = lambda *_: None,
) -> list[ResultRow]:
    """Run those ``planned`` jobs that are ``wanted`` and that ``out/results.csv`` lacks, and write it as they come.

    Gives all rows that there are then, those of earlier runs too, in the order of the plan.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / RESULTS
    known = {row.key: row for row in read_table(path, ResultRow)} if path.exists() else {}
    asked = {each.place.key: each for each in planned if wanted(each)}
    missing = [each for key, each in asked.items() if key not in known]
    for group in grouped(missing, lambda each: (each.spec.object, each.spec.seed)).values():
        for row in _run_all(group):
            known[row.key] = row
            write_table(path, _rows(planned, known))
            on_row(row, sum(key in known for key in asked), len(asked))
    return _rows(planned, known)


def _rows(planned: Sequence[Planned], known: Mapping[str, ResultRow]) -> list[ResultRow]:
    """The rows that there are; one job's stands in every place that asks for it."""
    there = [(each.place, known[each.place.key]) for each in planned if each.place.key in known]
    return [row.model_copy(update=place.model_dump()) for place, row in there]


def _run_all(group: Sequence[Planned]) -> Iterator[ResultRow]:
    """The rows of one object and seed; what is met afterwards is met by the object of one undisturbed job."""
    with tempfile.TemporaryDirectory(prefix="trompe-") as scratch, running_renderer() as target:
        undisturbed: Done | None = None
        for number, each in enumerate(group):
            folder = Path(scratch, str(number))
            if not each.case.afterwards:
                row, done = _run(each, target, folder)
                undisturbed = done if each.case.plain and not each.case.options else undisturbed
            else:
                undisturbed = undisturbed or run_job(each.spec, target, folder)
                row = _afterwards(each, undisturbed, target)
            yield row


def _run(each: Planned, target: TargetRenderer, folder: Path) -> tuple[ResultRow, Done | None]:
    started, case = time.perf_counter(), each.case
    with _threads(case.threads) as threads:
        known = {"threads": threads, "device": case.device}
        try:
            with _target_of(case, target) as met:
                done = run_job(
                    each.spec, met, folder, change=case.classifier, surrogate=case.surrogate, device=case.device
                )
        except TrompeError as error:
            failed = {"error": str(error), "seconds": time.perf_counter() - started}
            return ResultRow.of_spec(each.place, each.spec, state=JobState.failed.value, **known, **failed), None
    state = JobState.succeeded if done.painted is not None else JobState.not_applicable
    return ResultRow.of_result(each.place, done.result, state=state.value, **known), done


@contextmanager
def _threads(count: int | None) -> Iterator[int]:
    """Torch with so many threads; gives how many."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield count or before
    finally:
        torch.set_num_threads(before)


@contextmanager
def _target_of(case: Case, target: TargetRenderer) -> Iterator[TargetRenderer]:
    with ExitStack() as stack:
        own = target if case.renderer is None else stack.enter_context(case.renderer())
        yield own if case.target is None else case.target(own)


def _afterwards(each: Planned, done: Done, target: TargetRenderer) -> ResultRow:
    """The finished object in another world. What the job said of it is what its user would have read."""
    scene, case = done.scene, each.case
    judge = scene.classifier if case.classifier is None else case.classifier(scene.members[0])
    painted = scene.obj if done.painted is None else load_object(done.painted)
    shown = {}
    with _target_of(case, target) as met:
        for name, views in (("target", scene.views), ("held_out", scene.held_out)):
            before, after = (judge.predict(met.render(o, views, size=scene.size)) for o in (scene.obj, painted))
            shown[name] = accuracy(before, after, scene.label)
    result = done.result.model_copy(update=shown)
    return ResultRow.of_result(each.place, result, state=JobState.succeeded.value, threads=torch.get_num_threads())
