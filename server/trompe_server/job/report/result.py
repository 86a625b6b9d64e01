"""``result.json``."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch

from trompe_server.classifiers import Classifier
from trompe_server.image_pipelines import SUITE
from trompe_server.job.report.data import ReportData, distinct_views
from trompe_server.job.report.warnings import neighbour_warning, warnings_of
from trompe_server.judging.judge import Judge
from trompe_server.judging.metrics import fooled_as, transfer_gap, view_predictions
from trompe_server.judging.visibility import visibility_of
from trompe_server.surrogate import behind
from trompe_server.surrogate.fidelity import ViewFit
from trompe_server.system.versions import versions
from trompe_shared.api import (
    Accuracy,
    FooledAs,
    Judgement,
    PipelineJudgement,
    RendererResult,
    Result,
    ViewFidelity,
    ViewPrediction,
    Visibility,
)

S = TypeVar("S")
T = TypeVar("T")


def worst(seen: Sequence[ReportData]) -> ReportData:
    """The attacked renderer with the smallest ``a_drop``, on held-out views if there are any; the first of equals."""

    def drop(data: ReportData) -> float:
        judged = (data.held_out or data.target).a_drop
        return math.inf if judged is None else judged

    attacked = [data for data in seen if data.renderer.attacked]
    return min(attacked, key=drop) if len(attacked) > 1 else attacked[0]


def result_of(seen: Sequence[ReportData], warnings: Sequence[str]) -> Result:
    """The result, with ``warnings`` before its own, but without its ``seconds``. ``seen``: one for each renderer."""
    data = worst(seen)
    spec, setup = data.spec, data.setup
    beside = ThreadPoolExecutor(1, thread_name_prefix="visibility")
    visibility = beside.submit(_visibility, data)  # needs no network
    beside.shutdown(wait=False)
    became = _classes_of_fooled(data)
    synonyms = neighbour_warning(became, data.target, data.held_out)
    names = [setup.judge.class_name(label) for label in setup.labels] if setup.classifier.classes else None
    return Result(
        spec=spec,
        object=setup.object_name,
        label=setup.labels[0],
        label_name=names[0] if names else None,
        labels=list(setup.labels),
        label_names=names,
        classifier=setup.classifier.name,
        ensemble=[member.name for member in setup.members[1:]],
        epsilon=spec.paint.epsilon,
        alpha=spec.alpha,
        tau=spec.paint.tau,
        seed=spec.search.seed,
        steps=data.spent.steps,
        image_size=setup.size,
        renderers=[
            RendererResult(attacked=each.renderer.attacked, **_figures(each))
            for each in (seen if len(seen) > 1 else ())
        ],
        fooled_as=became,
        judges=[_judgement(network, data) for network in setup.judges],
        image_pipelines=_through_suite(data),
        probe_renders=sum(each.calibration.renders for each in seen if each.calibration is not None),
        attacked_views=len(setup.views) + data.spent.added,
        further_renders=data.spent.renders,
        **visibility.result().model_dump(),
        goal_reached=_goal_reached(data),
        evaluations=data.spent.evaluations,
        queries=data.spent.queries,
        warnings=[*warnings, *warnings_of(data, seen), *([synonyms] if synonyms else [])],
        seconds={},
        versions=versions(),
        **({"surrogate_model": spec.search.surrogate, "surrogate_reason": "not built"} | _figures(data)),
    )


def _classes_of_fooled(data: ReportData) -> list[FooledAs]:
    """The classes of the views recognised before the attack and not after, the most frequent first."""
    setup, after = data.setup, data.logits_after
    if after is None:
        return []
    own, held_out = (
        fooled_as(data.logits_before[views], after[views], setup.labels) if len(after[views]) else {}
        for views in ("own", "held_out")
    )
    found = [
        FooledAs(
            label=label,
            name=setup.judge.class_name(label) if setup.classifier.classes else None,
            own=own.get(label, 0),
            held_out=held_out.get(label, 0),
            neighbour=label in (setup.judge.near or ()),
        )
        for label in {**own, **held_out}
    ]
    return sorted(found, key=lambda each: (-each.own - each.held_out, each.label))


def _figures(data: ReportData) -> dict[str, Any]:
    """The figures and views of one renderer, by their names in ``Result`` and in ``RendererResult``."""
    setup, before, after = data.setup, data.logits_before, data.logits_after or {}
    own = view_predictions(setup.views, before["own"], after.get("own"), setup.labels)
    figures: dict[str, Any] = {
        "renderer": data.renderer.engine,
        "surrogate": data.predicted,
        "target": data.target,
        "held_out": data.held_out,
        "transfer_gap": transfer_gap(data.predicted, data.target),
        "views": _with_fits(own, data.fits),
        "held_out_views": view_predictions(setup.held_out, before["held_out"], after.get("held_out"), setup.labels),
    }
    if data.agreement is not None:
        figures |= data.agreement
    if (calibration := data.calibration) is not None:
        figures |= {"surrogate_model": calibration.model, "surrogate_reason": calibration.reason}
        figures["fidelity"] = _rounded(calibration.fidelity.mean())
    return figures


def _with_fits(views: Sequence[ViewPrediction], fits: Sequence[ViewFit | None]) -> list[ViewPrediction]:
    told = [None if fit is None else ViewFidelity(**_rounded(fit._asdict())) for fit in fits or [None] * len(views)]
    return [view.model_copy(update={"fidelity": fit}) for view, fit in zip(views, told, strict=True)]


def _goal_reached(data: ReportData) -> float | None:
    """Share of the own target views on which the goal is reached."""
    if data.logits_after is None:
        return None
    return float(data.setup.goal.reached(torch.from_numpy(data.logits_after["own"])).float().mean())


def _judgement(network: Classifier, data: ReportData) -> Judgement:
    judge = Judge.of(network, data.spec.goal.label, classes=data.setup.classifier.classes)

    def judged(views: str) -> Accuracy:
        after = None if data.after is None else network.predict(data.after[views])
        return judge.accuracy(network.predict(data.before[views]), after, distinct=data.distinct(views))

    held_out = judged("held_out") if data.setup.held_out else None
    return Judgement(classifier=network.name, target=judged("own"), held_out=held_out)


def _through_suite(data: ReportData) -> list[PipelineJudgement]:
    """Accuracy through each pipeline of the suite on every second held-out view: all would take a fifth of a job.

    The images of the next pipeline are made while the network sees those of one.
    """
    if data.after is None or not data.setup.held_out:
        return []
    views, seen = data.setup.held_out[::2], [images["held_out"][::2] for images in (data.before, data.after)]
    shown = _ahead(lambda pipeline: [pipeline.shown(images) for images in seen], SUITE.values())
    predict, judge, distinct = data.setup.classifier.predict, data.setup.judge, len(distinct_views(views))
    judged = (judge.accuracy(*map(predict, images), distinct=distinct) for images in shown)
    return [PipelineJudgement(pipeline=name, held_out=found) for name, found in zip(SUITE, judged, strict=True)]


def _ahead(make: Callable[[S], T], items: Iterable[S]) -> Iterator[T]:
    """``make`` of each item in order; a thread makes the next one meanwhile."""
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as executor:
        made: deque[Future[T]] = deque()
        for item in items:
            made.append(executor.submit(make, item))
            if len(made) > 1:
                yield made.popleft().result()
        yield from (each.result() for each in made)


def _rounded(figures: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 5) for name, value in figures.items()}


def _visibility(data: ReportData) -> Visibility:
    """Over all target views."""
    if data.after is None or data.painted is None:
        return Visibility()
    setup, paint = data.setup, data.spec.paint
    before, after = (np.concatenate([each["own"], each["held_out"]]) for each in (data.before, data.after))
    return visibility_of(
        *(setup.obj.textures, data.painted.textures),
        *(before, after, behind([*setup.views, *setup.held_out], setup.backdrops, setup.size)),
        epsilon=paint.epsilon if paint.epsilon_view is None else paint.epsilon_view,
    )
