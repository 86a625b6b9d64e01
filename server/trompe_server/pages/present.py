"""Text, figures and addresses of the pages, from jobs and results. No I/O."""

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

from trompe_server.job.protocol import THUMBNAIL, numbered
from trompe_server.pages.results import Outcome
from trompe_server.pages.sphere import Sphere, sphere
from trompe_shared.api import (
    MANIFEST_PAGE,
    OPTIONS,
    VIEW_LIMITS,
    Accuracy,
    Job,
    JobSpec,
    JobState,
    Option,
    Result,
    ViewPrediction,
)
from trompe_shared.local_files import LOOKED_UP

ClassNames = Callable[[int], str]

TERMS: Final = {
    "A_before": "share of views classified as the object's class before the attack",
    "A_after": "the same after the attack",
    "A_drop": "(A_before - A_after) / A_before; n.a. if A_before is 0",
    "surrogate": "differentiable model of the target renderer, used by the attack",
    "target": "black-box renderer of the classifier's images",
    "held-out": "cameras and lights hidden from the attack",
    "neighbour": "class whose name shares a noun with that of the object's class: perhaps a near-synonym",
    "epsilon": "largest change of a texel, as a share of full brightness",
}

MEASURES: Final = {
    "transfer_gap": "Transfer gap",
    "disagreement": "Views on which surrogate and target disagree",
    "texels_altered": "Texels altered (N%)",
    "mean_texel_change": "Mean change of a texel",
    "max_view_change": "Largest change of a pixel",
    "ssim": "SSIM",
    "delta_e": "CIEDE2000",
    "evaluations": "Images shown to the classifier",
    "attacked_views": "Attacked views",
    "probe_renders": "Probe renders",
}
SHARES: Final = {"disagreement", "texels_altered"}
PICTURES: Final = {
    "textures.png": "The texture: before, after, and the difference",
    "saliency_object.png": "Saliency on the object",
    "predictions.png": "Predictions over all views",
}
PHASES: Final = {
    "open": "opening",
    "prepare": "preparing",
    "calibrate": "calibrating",
    "attack": "attacking",
    "judge": "judging",
    "report": "report",
}


class JobRow(Job):
    """A job in a list, with names in place of ids. ``outcome``: of an ended job with a result."""

    object: str
    label: str
    classifier: str
    epsilon: str
    outcome: Outcome | None = None

    @classmethod
    def of(cls, job: Job, *, epsilon: float | None, **names: str) -> Self:
        """A stored job with the names of its object, label and classifier."""
        told = "none stated" if epsilon is None else f"{epsilon:g}"
        return cls.model_construct(None, **dict(job), **names, epsilon=told)

    @property
    def live(self) -> bool:
        return not self.state.final

    @property
    def phase(self) -> str:
        """The present phase in words; a running job that has reported none is being opened."""
        phase = self.progress.phase
        phase = "open" if self.state is JobState.running and phase == JobState.queued else phase
        return PHASES.get(phase.partition("-")[0], phase)

    @property
    def eta(self) -> str | None:
        """Estimated time left, as a range if the attack may end early."""
        if not self.live or self.progress.eta_seconds is None:
            return None
        most, least = self.progress.eta_seconds, self.progress.eta_least_seconds or self.progress.eta_seconds
        return span(most) if span(least) == span(most) else f"{span(least)} to {span(most)}"

    @property
    def words(self) -> str:
        """How the job ended."""
        if self.error:
            return self.error.partition(". ")[0]
        if self.started and self.finished:
            return f"took {span((self.finished - self.started).total_seconds())}"
        return ""

    @property
    def thumbnail(self) -> str | None:
        """Address of a small picture of a view before and after, if there is one."""
        return f"/v1/jobs/{self.id}/artifacts/{THUMBNAIL}" if THUMBNAIL in self.artifacts else None

    @property
    def judgement(self) -> str | None:
        """Address of the page of a judgement, once it is there."""
        return f"/v1/judgements/{self.id}/page" if MANIFEST_PAGE in self.artifacts else None

    @property
    def percent(self) -> int:
        return round(100 * self.progress.fraction)

    @property
    def version(self) -> str:
        """Changes with the displayed values."""
        return f"{self.state}-{self.progress.fraction:.3f}-{self.phase}-{self.eta}"


def span(seconds: float) -> str:
    """A duration for people."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


@dataclass(frozen=True)
class Shown:
    """A result as displayed on its page."""

    result: Result
    verdict: str
    viewer: Sequence[Mapping[str, Any]]
    sphere: Sphere
    accuracies: Sequence[Mapping[str, Any]]
    measures: Sequence[Mapping[str, str]]
    pictures: Sequence[Mapping[str, str]]
    times: Sequence[Mapping[str, Any]]
    surrogates: Sequence[str]
    command: str


def present(result: Result, job: JobRow, *, names: ClassNames) -> Shown:
    """Prepare a result for its page. ``names`` maps class indices to names."""
    sets = _view_sets(result, names, f"/jobs/{job.id}/pictures")
    own = result.spec.victim.classifier
    return Shown(
        result=result,
        verdict=_verdict(result, job),
        viewer=sets,
        sphere=sphere([each["views"] for each in sets]),
        accuracies=list(_accuracies(result)),
        measures=list(_measures(result)),
        pictures=[
            {"title": title, "url": f"/v1/jobs/{job.id}/artifacts/{name}"}
            for name, title in PICTURES.items()
            if name in job.artifacts
        ],
        times=_times(result.seconds),
        surrogates=[
            f"Surrogate: {name}{each.surrogate_model}. {each.surrogate_reason}"
            for name, each in result.by_renderer
            if each.surrogate_model
        ],
        command=command(
            result.spec, object=job.object, classifier=own if own.startswith(LOOKED_UP) else job.classifier
        ),
    )


def _view_sets(result: Result, names: ClassNames, place: str) -> list[dict[str, Any]]:
    """Held-out and own views in each renderer, those of the headline first; addresses begin with ``place``."""
    sets = []
    for number, (name, each) in enumerate(result.by_renderer):
        for title, kind, views in (
            ("held-out", "held_out", each.held_out_views),
            ("the attack's own", "own", each.views),
        ):
            if views:
                shown = _views(views, result, names, f"{place}/{numbered(kind, number)}")
                headline = each.renderer == result.renderer
                sets.append({"name": name + title, "views": shown, "own": kind == "own", "headline": headline})
    return sorted(sets, key=lambda each: not each["headline"])


def _verdict(result: Result, job: JobRow) -> str:
    judged, where = (
        (result.held_out, "views hidden from the attack") if result.held_out else (result.target, "views of the attack")
    )
    if judged.a_after is None:
        return f"The classifier does not recognise the unpainted object as {job.label}, so there was no attack."
    return (
        f"On {judged.counted} {where}, the classifier recognised it as {job.label} in {judged.a_before:.0%} before "
        f"and in {judged.a_after:.0%} after."
    )


def _views(views: Sequence[ViewPrediction], result: Result, names: ClassNames, place: str) -> list[dict[str, Any]]:
    """All views for the viewer, sorted by azimuth."""
    order = sorted(range(len(views)), key=lambda k: (views[k].azimuth % 360, views[k].elevation))
    return [viewer_record(views[k], result.labels, names, f"{place}/{k}") for k in order]


def viewer_record(view: ViewPrediction, labels: Sequence[int], names: ClassNames, place: str) -> dict[str, Any]:
    """One view for the viewer; the addresses of its pictures begin with ``place``."""
    attacked, known = view.after is not None, view.before in labels
    after = view.before if view.after is None else view.after
    confidence = view.before_confidence if view.after_confidence is None else view.after_confidence
    truth = view.before_true_confidence if view.after_true_confidence is None else view.after_true_confidence
    return {
        "before": f"{place}/before.png",
        "after": f"{place}/{'after' if attacked else 'before'}.png",
        "difference": f"{place}/difference.png" if attacked else None,
        "says_before": f"{names(view.before)} {view.before_confidence:.0%}",
        "says_after": f"{names(after)} {confidence:.0%}",
        "truth_before": f"{view.before_true_confidence:.0%}",
        "truth_after": f"{truth:.0%}",
        "kept_before": known,
        "kept_after": after in labels,
        "fate": "kept" if after in labels else "fooled" if known else "never",
        "confidence": round(confidence, 3),
        "azimuth": view.azimuth,
        "elevation": view.elevation,
        "where": f"Camera: azimuth {view.azimuth:.0f}°, elevation {view.elevation:.0f}°, {view.distance:.2f} m. "
        f"Light: azimuth {view.light_azimuth:.0f}°, elevation {view.light_elevation:.0f}°.",
    }


def _accuracies(result: Result) -> Iterable[dict[str, Any]]:
    for name, accuracy in result.accuracies:
        shares = (accuracy.a_before, accuracy.a_after, accuracy.a_drop)
        interval = accuracy.a_drop_interval
        ends = f"{interval[0]:.2f} to {interval[1]:.2f}" if interval else "n.a."
        yield {
            "name": name,
            "views": accuracy.counted,
            "cells": [*map(_share, shares), ends],
            "drop": accuracy.a_drop,
            "ends": interval,
        }


def _share(value: float | None) -> str:
    return "n.a." if value is None else f"{value:.2f}"


def _measures(result: Result) -> Iterable[dict[str, str]]:
    for field, name in MEASURES.items():
        value = getattr(result, field)
        if value is not None:
            text = f"{value:.1%}" if field in SHARES else f"{value:.3g}" if isinstance(value, float) else f"{value}"
            yield {"name": name, "value": text, "help": Result.model_fields[field].description or name}


def _times(seconds: Mapping[str, float]) -> list[dict[str, Any]]:
    whole = sum(seconds.values()) or 1.0
    return [
        {"name": PHASES.get(name, name), "seconds": f"{took:.1f}", "percent": round(100 * took / whole)}
        for name, took in seconds.items()
    ]


def command(spec: JobSpec, *, object: str, classifier: str) -> str:
    """Command line of the same job, with the options that differ from the defaults, without masks."""
    named = {"label": spec.goal.label, "classifier": classifier}
    values = named | spec.changed() | named
    words = [word for keyword, value in values.items() for word in _flags(OPTIONS[keyword], value)]
    return shlex.join(["trompe", "attack", object, *words, "--out", "result"])


def _flags(option: Option, value: Any) -> list[str]:
    """An option as words of the command line."""
    if option.file == "mask":  # its pictures are on the server
        return []
    if isinstance(value, bool):
        return [option.flag if value else f"--no{option.flag[1:]}"]
    given: Iterable[Any] = [value]
    if isinstance(value, dict):
        given = [(name, *ends) for name, ends in value.items() if name in VIEW_LIMITS]
    elif isinstance(value, list):
        given = value
    rows = (each if isinstance(each, tuple) else (each,) for each in given)
    return [word for row in rows for word in (option.flag, *map(_word, row))]


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def differences(asked: Sequence[Mapping[str, Any]], results: Sequence[Result]) -> list[dict[str, Any]]:
    """Options and results of several jobs, as rows of a table."""
    lines = [{"name": name, "cells": [value_text(options[name]) for options in asked]} for name in asked[0]]
    for field, title in {"target": "target", "held_out": "held-out"}.items():
        judged: list[Accuracy | None] = [getattr(side, field) for side in results]
        drops = [each.a_drop if each else None for each in judged]
        lines.append({"name": f"A_drop, {title}", "cells": [_share(drop) for drop in drops]})
    for field, name in MEASURES.items():
        lines.append({"name": name, "cells": [value_text(getattr(side, field)) for side in results]})
    seconds = [sum(side.seconds.values()) for side in results]
    lines.append({"name": "seconds", "cells": [f"{took:.1f}" for took in seconds]})
    return [line | {"differs": len(set(line["cells"])) > 1} for line in lines]


def value_text(value: Any) -> str:
    """An option or a figure as text; a dash for none."""
    if value is None or value in ([], {}):
        return "–"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {value_text(each)}" for name, each in value.items())
    if isinstance(value, (list, tuple)):
        return " ".join(value_text(each) for each in value)
    return str(value)
