"""Cases of the stability suite.

*Measured* disturbances are present all the time: calibration measures them, and a job should warn if that does not
suffice. *Unforeseen* ones start after the job, on the finished object: no warning is possible, and the figures show how
much of the attack survives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from trompe_experiments.design import Experiment, load_experiment
from trompe_experiments.in_process import Change
from trompe_experiments.plan import Plan, plan_experiment
from trompe_experiments.stability import AFTERWARDS, REFERENCE
from trompe_experiments.stability.disturbed import bfloat16, quantised, saturated
from trompe_shared.errors import SpecError

NAME: Final = "stability_targets"


@dataclass(frozen=True)
class Case:
    """Disturbance of a job.

    options: options of the job. renderer: fields of the ``Disturbance`` of its renderer. classifier: replacement of
    the network. afterwards: the finished object of an undisturbed job meets the disturbance.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    renderer: Mapping[str, float] = field(default_factory=dict)
    classifier: Change | None = None
    afterwards: bool = False


DISTURBANCES: Final[Mapping[str, Case]] = {
    "field of view 61 degrees": Case(renderer={"field_of_view": 61}),
    "camera jitter 1 degree, 1 %": Case(renderer={"jitter": 1}),
    "light 30 degrees elsewhere": Case(renderer={"turn": 30}),
    "light from behind, half as bright": Case(renderer={"turn": 180, "dim": 0.5}),
    "JPEG, quality 75": Case(renderer={"jpeg": 75}),
    "JPEG, quality 30": Case(renderer={"jpeg": 30}),
    "resized to half and back": Case(renderer={"resize": 0.5}),
    "rendered at 3/4 of the size": Case(renderer={"scale": 0.75}),
    "grain, 1/255": Case(renderer={"grain": 1}),
    "grain, 8/255": Case(renderer={"grain": 8}),
    "filmic tone curve": Case(renderer={"filmic": True}),
    "exposure by the whole picture": Case(renderer={"exposure": 0.3}),
    "interreflection": Case(renderer={"bounce": 0.3}),
    "flickering light": Case(renderer={"flicker": 0.2}),
}
"""Disturbances of a target, measured or unforeseen."""

MEASURED: Final[Mapping[str, Case]] = {
    REFERENCE: Case(),
    **DISTURBANCES,
    "grain, 8/255, assumed light only": replace(DISTURBANCES["grain, 8/255"], options={"surrogate": "diffuse"}),
    "light 30 degrees elsewhere, assumed light only": replace(
        DISTURBANCES["light 30 degrees elsewhere"], options={"surrogate": "diffuse"}
    ),
    "network in bfloat16": Case(classifier=bfloat16),
    "saturated softmax, margin loss": Case(classifier=lambda network: saturated(network, 50.0)),
    "saturated softmax, cross-entropy": Case(
        classifier=lambda network: saturated(network, 50.0), options={"loss": "cross_entropy"}
    ),
    "gradient masking (8 levels)": Case(classifier=lambda network: quantised(network, 8)),
}
"""Cases whose disturbance is present all the time."""

UNFORESEEN: Final[Mapping[str, Case]] = {**DISTURBANCES, "network in bfloat16": Case(classifier=bfloat16)}
"""Cases whose disturbance starts after the attack."""

CASES: Final[Mapping[str, Case]] = {
    **MEASURED,
    **{f"{AFTERWARDS}{words}": replace(case, afterwards=True) for words, case in UNFORESEEN.items()},
}
"""All cases by the name in tables and charts."""


def stability_plan(
    *, objects: Sequence[str], seeds: int, only: str = "", options: Mapping[str, Any] | None = None
) -> Plan:
    """Jobs of the cases whose name contains ``only``, on shipped objects, with the options of the experiment
    ``stability``, which ``options`` override. Raises ``SpecError`` without such a case."""
    chosen = {words: dict(case.options) for words, case in CASES.items() if only in words}
    if not chosen:
        raise SpecError(f"No case of the stability suite contains {only!r}; cases: {'; '.join(CASES)}.")
    file = {
        "name": NAME,
        "base": {**load_experiment("stability").base, **(options or {})},
        "objects": {name: {} for name in objects},
        "cases": chosen,
        "seeds": seeds,
    }
    return plan_experiment(Experiment.model_validate(file))
