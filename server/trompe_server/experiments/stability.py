"""The stability suite: whole jobs against targets and classifiers that are not what they are taken for.

Each case is a job from beginning to end on the library itself, without a service. *Measured* disturbances are there all
the time: what the service measures of its target includes them, and it should say so where that does not do.
*Unforeseen* ones come afterwards, to the finished object: nothing could have noticed them, and the figures say what is
left of an attack that met the world it was made for.
"""

import hashlib
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import torch

from trompe_server.attack.metrics import accuracy
from trompe_server.experiments.disturbed import (
    DisturbedTarget,
    bfloat16,
    bounce,
    brighter_when_dark,
    flicker,
    grain,
    jittered,
    jpeg,
    quantised,
    relit,
    renderer,
    resized_twice,
    saturated,
    smaller,
)
from trompe_server.experiments.in_process import Change, Done, run_job
from trompe_server.target import TargetRenderer
from trompe_shared.api import JobSpec, JobState
from trompe_shared.errors import TrompeError
from trompe_shared.experiment_table import RESULTS, ResultRow, RowId, read_table, write_table
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["MEASURED", "UNFORESEEN", "Case", "run_suite"]

Disturb = Callable[[TargetRenderer], TargetRenderer]

NAME: Final = "stability_targets"
BASE: Final[Mapping[str, Any]] = {"classifier": "tiny", "epsilon": 0.05, "pool": 120, "steps": 20, "held_out": 100}
REFERENCE: Final = "as it should be"


@dataclass(frozen=True)
class Case:
    """One thing that is not as it should be.

    target: what stands in the place of the renderer. classifier: what stands in the place of the network. renderer: a
    renderer worker of its own. options: fields of the job.
    """

    target: Disturb | None = None
    classifier: Change | None = None
    renderer: Callable[[], AbstractContextManager[TargetRenderer]] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


def _seen(see: Any) -> Case:
    return Case(lambda target: DisturbedTarget(target, see=see))


def _aimed(aim: Any) -> Case:
    return Case(lambda target: DisturbedTarget(target, aim=aim))


DISTURBANCES: Final[Mapping[str, Case]] = {
    "field of view 61 degrees": Case(renderer=lambda: renderer(field_of_view=61.0)),
    "camera jitter 1 degree, 1 %": _aimed(jittered(1.0, 0.01)),
    "light 30 degrees elsewhere": _aimed(relit(30.0)),
    "light from behind, half as bright": _aimed(relit(180.0, intensity=0.5)),
    "JPEG, quality 75": _seen(jpeg(75)),
    "JPEG, quality 30": _seen(jpeg(30)),
    "resized to half and back": _seen(resized_twice(0.5)),
    "rendered at 3/4 of the size": Case(lambda target: smaller(target, 0.75)),
    "grain, 1/255": _seen(grain(1)),
    "grain, 8/255": _seen(grain(8)),
    "exposure by the whole picture": _seen(brighter_when_dark(0.3)),
    "interreflection": _seen(bounce(0.3)),
    "flickering light": _seen(flicker(0.2)),
}
"""What may be wrong with a target, all the time or only afterwards."""

MEASURED: Final[Mapping[str, Case]] = {
    REFERENCE: Case(),
    **DISTURBANCES,
    "grain, 8/255, assumed light only": Case(
        lambda target: DisturbedTarget(target, see=grain(8)), options={"surrogate": "diffuse"}
    ),
    "light 30 degrees elsewhere, assumed light only": Case(
        lambda target: DisturbedTarget(target, aim=relit(30.0)), options={"surrogate": "diffuse"}
    ),
    "network in bfloat16": Case(classifier=bfloat16),
    "saturated softmax, margin loss": Case(classifier=lambda network: saturated(network, 50.0)),
    "saturated softmax, cross-entropy": Case(
        classifier=lambda network: saturated(network, 50.0), options={"loss": "cross_entropy"}
    ),
    "gradient masking (8 levels)": Case(classifier=lambda network: quantised(network, 8)),
}
"""Cases whose disturbance is there all the time."""

UNFORESEEN: Final[Mapping[str, Case]] = {
    **DISTURBANCES,
    "network in bfloat16": Case(classifier=bfloat16),
}
"""Cases in which the object was made for a world as it should be."""


def run_suite(
    out: Path,
    *,
    objects: Sequence[str],
    seeds: Sequence[int],
    options: Mapping[str, Any] | None = None,
    only: str = "",
    on_row: Callable[[ResultRow, int, int], None] = lambda *_: None,
) -> list[ResultRow]:
    """Run all cases whose name contains ``only`` on shipped objects, and write ``out/results.csv`` as they come.

    Rows that are there already are kept, and their cases are not run again. ``options`` are fields of all jobs.
    ``on_row`` is told each new row, how many there are and how many there will be.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / RESULTS
    known = {row.key: row for row in read_table(path, ResultRow)} if path.exists() else {}
    every = [place for name in objects for seed in seeds for place in _places(name, seed, options or {}, only)]
    rows: dict[str, ResultRow] = {place.key: known[place.key] for place, *_ in every if place.key in known}
    for name in objects:
        for seed in seeds:
            wanted = [each for each in _places(name, seed, options or {}, only) if each[0].key not in rows]
            for row in _run_all(wanted):
                rows[row.key] = row
                ordered = [rows[place.key] for place, *_ in every if place.key in rows]
                write_table(path, _by_case(ordered))
                on_row(row, len(rows), len(every))
    return _by_case(list(rows.values()))


Place = tuple[RowId, str, Case, JobSpec, bool]
"""Where a row belongs, its case's name, the case, its job, and whether the disturbance comes afterwards."""


def _places(name: str, seed: int, options: Mapping[str, Any], only: str) -> list[Place]:
    cases = [(words, case, False) for words, case in MEASURED.items()]
    cases += [(f"unforeseen: {words}", case, True) for words, case in UNFORESEEN.items()]
    found = []
    for words, case, after in cases:
        if only not in words:
            continue
        fields = {**BASE, **options, **case.options, "object": name, "label": shipped_objects()[name].label}
        spec = JobSpec.model_validate(fields | {"seed": seed})
        digest = hashlib.sha256(f"{words} {spec.model_dump_json()}".encode()).hexdigest()[:24]
        place = RowId(experiment=NAME, key=f"{NAME}-{digest}", case=words, configuration=words)
        found.append((place, words, case, spec, after))
    return found


def _by_case(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Rows in the order of the suite's cases."""
    order = [*MEASURED, *(f"unforeseen: {words}" for words in UNFORESEEN)]
    return sorted(rows, key=lambda row: (order.index(row.case), row.object, row.seed))


def _run_all(places: Sequence[Place]) -> Iterator[ResultRow]:
    """The rows of one object and seed; those whose disturbance comes afterwards share one undisturbed job."""
    if not places:
        return
    with tempfile.TemporaryDirectory(prefix="trompe-") as scratch, renderer() as target:
        plain: Done | None = None
        for number, (place, _, case, spec, after) in enumerate(places):
            folder = Path(scratch, str(number))
            if not after:
                yield _measured(place, case, spec, target, folder)
                continue
            plain = plain or run_job(spec, target, folder)
            yield _unforeseen(place, case, plain, target)


def _measured(place: RowId, case: Case, spec: JobSpec, target: TargetRenderer, folder: Path) -> ResultRow:
    started = time.perf_counter()
    try:
        with _target_of(case, target) as disturbed:
            done = run_job(spec, disturbed, folder, change=case.classifier)
    except TrompeError as error:
        names = {"error": str(error), "seconds": time.perf_counter() - started}
        return ResultRow.of_spec(place, spec, state=JobState.failed.value, threads=torch.get_num_threads(), **names)
    state = JobState.succeeded if done.painted is not None else JobState.not_applicable
    return ResultRow.of_result(place, done.result, state=state.value, threads=torch.get_num_threads())


class _target_of:  # noqa: N801
    """The target of a case, for as long as the block lasts."""

    def __init__(self, case: Case, target: TargetRenderer) -> None:
        self._case, self._target = case, target
        self._own: AbstractContextManager[TargetRenderer] | None = None

    def __enter__(self) -> TargetRenderer:
        target = self._target
        if self._case.renderer is not None:
            self._own = self._case.renderer()
            target = self._own.__enter__()
        return target if self._case.target is None else self._case.target(target)

    def __exit__(self, *exc_info: Any) -> None:
        if self._own is not None:
            self._own.__exit__(*exc_info)


def _unforeseen(place: RowId, case: Case, plain: Done, target: TargetRenderer) -> ResultRow:
    """The finished object in another world. What the job said of it is what its user would have read."""
    scene = plain.scene
    judge = scene.classifier if case.classifier is None else case.classifier(scene.members[0])
    painted = scene.obj if plain.painted is None else load_object(plain.painted)
    shown = {}
    with _target_of(case, target) as disturbed:
        for name, views in (("target", scene.views), ("held_out", scene.held_out)):
            before, after = (judge.predict(disturbed.render(o, views, size=scene.size)) for o in (scene.obj, painted))
            shown[name] = accuracy(before, after, scene.label)
    result = plain.result.model_copy(update=shown)
    return ResultRow.of_result(place, result, state=JobState.succeeded.value, threads=torch.get_num_threads())
