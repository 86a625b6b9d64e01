"""The stability suite: whole jobs against targets and classifiers that are not what they are taken for.

Each case is a job from beginning to end on the library itself, without a service. *Measured* disturbances are there all
the time: what the service measures of its target includes them, and it should say so where that does not do.
*Unforeseen* ones come afterwards, to the finished object: nothing could have noticed them, and the figures say what is
left of an attack that met the world it was made for.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from trompe_server.experiments.disturbed import (
    DisturbedTarget,
    bfloat16,
    bounce,
    brighter_when_dark,
    filmic,
    flicker,
    grain,
    jittered,
    jpeg,
    quantised,
    relit,
    resized_twice,
    saturated,
    smaller,
)
from trompe_server.experiments.own_renderer import running_renderer
from trompe_server.experiments.suite import Case, OnRow, plan_jobs, run_planned
from trompe_shared.experiment_table import ResultRow, RowId

__all__ = ["MEASURED", "UNFORESEEN", "run_suite"]

NAME: Final = "stability_targets"
BASE: Final[Mapping[str, Any]] = {"classifier": "tiny", "epsilon": 0.05, "pool": 120, "steps": 20, "held_out": 100}
REFERENCE: Final = "as it should be"


def _seen(see: Any) -> Case:
    return Case(target=lambda target: DisturbedTarget(target, see=see))


def _aimed(aim: Any) -> Case:
    return Case(target=lambda target: DisturbedTarget(target, aim=aim))


DISTURBANCES: Final[Mapping[str, Case]] = {
    "field of view 61 degrees": Case(renderer=lambda: running_renderer(field_of_view=61.0)),
    "camera jitter 1 degree, 1 %": _aimed(jittered(1.0, 0.01)),
    "light 30 degrees elsewhere": _aimed(relit(30.0)),
    "light from behind, half as bright": _aimed(relit(180.0, intensity=0.5)),
    "JPEG, quality 75": _seen(jpeg(75)),
    "JPEG, quality 30": _seen(jpeg(30)),
    "resized to half and back": _seen(resized_twice(0.5)),
    "rendered at 3/4 of the size": Case(target=lambda target: smaller(target, 0.75)),
    "grain, 1/255": _seen(grain(1)),
    "grain, 8/255": _seen(grain(8)),
    "filmic tone curve": _seen(filmic),
    "exposure by the whole picture": _seen(brighter_when_dark(0.3)),
    "interreflection": _seen(bounce(0.3)),
    "flickering light": _seen(flicker(0.2)),
}
"""What may be wrong with a target, all the time or only afterwards."""

MEASURED: Final[Mapping[str, Case]] = {
    REFERENCE: Case(),
    **DISTURBANCES,
    "grain, 8/255, assumed light only": Case(
        target=lambda target: DisturbedTarget(target, see=grain(8)), options={"surrogate": "diffuse"}
    ),
    "light 30 degrees elsewhere, assumed light only": Case(
        target=lambda target: DisturbedTarget(target, aim=relit(30.0)), options={"surrogate": "diffuse"}
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
    on_row: OnRow = lambda *_: None,
) -> list[ResultRow]:
    """Run the cases whose name contains ``only`` on shipped objects; see ``run_planned``. ``options`` are fields of all
    jobs."""
    cases = {
        **MEASURED,
        **{f"unforeseen: {words}": replace(case, afterwards=True) for words, case in UNFORESEEN.items()},
    }
    fields = {**BASE, **(options or {})}
    planned = [
        job
        for words, case in cases.items()
        for job in plan_jobs(
            RowId(experiment=NAME, key="", case=words, configuration=words), case, fields, objects=objects, seeds=seeds
        )
    ]
    return run_planned(out, planned, wanted=lambda each: only in each.place.case, on_row=on_row)
