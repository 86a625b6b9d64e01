"""From jobs and results to what a page shows: words, figures and addresses. No requests, no files."""

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from trompe_shared.api import Accuracy, Job, JobSpec, LightFound, Result, VerticesMoved, ViewPrediction

__all__ = [
    "TERMS",
    "ClassNames",
    "JobRow",
    "Shown",
    "command",
    "differences",
    "job_row",
    "present",
    "value_text",
    "viewer_record",
]

ClassNames = Callable[[int], str]

TERMS: Final = {
    "A_before": "share of views that are classified as the object's class before the attack",
    "A_after": "the same after the attack",
    "A_drop": "(A_before - A_after) / A_before; n.a. where A_before is 0",
    "surrogate": "the differentiable model of the target renderer that the attack computes with",
    "target": "the black-box renderer whose images the classifier sees",
    "held-out": "cameras and lights that the attack never saw",
    "epsilon": "the most that a texel's colour may change, as a share of full brightness",
}

MEASURES: Final = {
    "transfer_gap": "Transfer gap",
    "texels_altered": "Texels altered (N%)",
    "mean_texel_change": "Mean change of a texel",
    "max_view_change": "Largest change of a pixel",
    "ssim": "SSIM",
    "delta_e": "CIEDE2000",
    "evaluations": "Images shown to the classifier",
    "probe_renders": "Probe renders",
}
SHARES: Final = {"texels_altered"}
PICTURES: Final = {
    "light_map.png": "The sky from above: lights that were tried, redder where they fool more; the best one ringed",
    "textures.png": "The texture: before, after, and the difference",
    "saliency_object.png": "Where the classifier looks, on the object",
    "predictions.png": "What it is taken for, over all views",
}
PHASES: Final = {"prepare": "looking", "calibrate": "probing", "attack": "attacking", "judge": "judging"}


@dataclass(frozen=True)
class JobRow:
    """A job in a list. ``change`` says what may change. ``version`` differs where anything that is shown does."""

    id: str
    object: str
    label: str
    classifier: str
    change: str
    epsilon: str
    state: str
    live: bool
    fraction: float
    phase: str
    eta: str | None
    words: str
    error: str | None
    note: str | None
    created: datetime
    artifacts: Sequence[str]

    @property
    def percent(self) -> int:
        """Progress in per cent."""
        return round(100 * self.fraction)

    @property
    def version(self) -> str:
        """Changes with what is shown."""
        return f"{self.state}-{self.fraction:.3f}-{self.phase}-{self.eta}"


def job_row(job: Job, *, object: str, classifier: str, label: str) -> JobRow:
    """A job, with the names of what its ids stand for."""
    progress, live = job.progress, not job.state.final
    kind = progress.phase.partition("-")[0]
    return JobRow(
        id=job.id,
        object=object,
        label=label,
        classifier=classifier,
        change=_change(job.spec),
        epsilon=f"{job.spec.epsilon:g}" if job.spec.attack_on == "texture" else job.spec.attack_on,
        state=job.state.value,
        live=live,
        fraction=progress.fraction,
        phase=PHASES.get(kind, kind),
        eta=span(progress.eta_seconds) if live and progress.eta_seconds is not None else None,
        words=_how_it_ended(job),
        error=job.error,
        note=job.note,
        created=job.created,
        artifacts=job.artifacts,
    )


def _change(spec: JobSpec) -> str:
    kinds = {"light": "the light", "vertices": f"vertices within {spec.vertex_budget:.1%} of the radius"}
    return kinds.get(spec.attack_on, f"epsilon {spec.epsilon:g}")


def _how_it_ended(job: Job) -> str:
    if job.error:
        return job.error.partition(". ")[0]
    if job.started and job.finished:
        return f"took {span((job.finished - job.started).total_seconds())}"
    return ""


def span(seconds: float) -> str:
    """A length of time for people."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


@dataclass(frozen=True)
class Shown:
    """A result as its page shows it."""

    verdict: str
    viewer: Sequence[Mapping[str, Any]]
    strip: Sequence[Mapping[str, Any]]
    accuracies: Sequence[Mapping[str, Any]]
    measures: Sequence[Mapping[str, str]]
    warnings: Sequence[str]
    pictures: Sequence[Mapping[str, str]]
    times: Sequence[Mapping[str, Any]]
    surrogate: str
    command: str


def present(result: Result, job: JobRow, *, names: ClassNames) -> Shown:
    """A result; ``names`` says what a class is called."""
    own = _views(result.views, result, names, f"/jobs/{job.id}/pictures/own")
    sets = [{"name": "the attack's own", "views": own}]
    if result.held_out_views:
        unseen = _views(result.held_out_views, result, names, f"/jobs/{job.id}/pictures/held_out")
        sets.append({"name": "held-out", "views": unseen})
    return Shown(
        verdict=_verdict(result, job),
        viewer=sets,
        strip=[{"picture": view["after"], "says": view["says_after"], "kept": view["kept_after"]} for view in own],
        accuracies=list(_accuracies(result)),
        measures=list(_measures(result)),
        warnings=result.warnings,
        pictures=[
            {"title": title, "url": f"/v1/jobs/{job.id}/artifacts/{name}"}
            for name, title in PICTURES.items()
            if name in job.artifacts
        ],
        times=_times(result.seconds),
        surrogate=f"Surrogate: {result.surrogate_model}. {result.surrogate_reason}",
        command=command(result.spec, object=job.object, classifier=job.classifier),
    )


def _verdict(result: Result, job: JobRow) -> str:
    judged, where = (result.held_out, "views it was not made for") if result.held_out else (result.target, "its views")
    if judged.a_after is None:
        return f"The classifier does not take it for {job.label} even unpainted, so there was nothing to attack."
    return (
        f"Over {judged.views} {where}, the classifier took it for {job.label} in {judged.a_before:.0%} before "
        f"and in {judged.a_after:.0%} after."
    )


def _views(views: Sequence[ViewPrediction], result: Result, names: ClassNames, place: str) -> list[dict[str, Any]]:
    """All views around the object, one after the other by azimuth, as the viewer wants them."""
    order = sorted(range(len(views)), key=lambda k: (views[k].azimuth % 360, views[k].elevation))
    moved = f"; after the attack {_light(result.light)}" if result.light else ""
    records = [viewer_record(views[k], result.label, names, f"{place}/{k}") for k in order]
    return [record | {"where": record["where"] + moved} for record in records]


def _light(light: LightFound) -> str:
    strength = [
        f"{name} {value:.2g}" for name in ("intensity", "ambient") if (value := getattr(light, name)) is not None
    ]
    return ", ".join([f"from {light.azimuth:.0f}° around", f"{light.elevation:.0f}° up", *strength])


def viewer_record(view: ViewPrediction, label: int, names: ClassNames, place: str) -> dict[str, Any]:
    """One view as the viewer wants it; its pictures are below ``place``."""
    attacked = view.after is not None
    after, confidence = (view.after, view.after_confidence) if attacked else (view.before, view.before_confidence)
    assert after is not None
    assert confidence is not None
    return {
        "before": f"{place}/before.png",
        "after": f"{place}/{'after' if attacked else 'before'}.png",
        "difference": f"{place}/difference.png" if attacked else None,
        "says_before": f"{names(view.before)} {view.before_confidence:.0%}",
        "says_after": f"{names(after)} {confidence:.0%}",
        "kept_before": view.before == label,
        "kept_after": after == label,
        "where": f"Camera at {view.azimuth:.0f}° around, {view.elevation:.0f}° up, {view.distance:.2f} m away; "
        f"light from {view.light_azimuth:.0f}° around, {view.light_elevation:.0f}° up",
    }


def _accuracies(result: Result) -> Iterable[dict[str, Any]]:
    rows: list[tuple[str, Accuracy | None]] = [
        ("surrogate", result.surrogate),
        ("target", result.target),
        ("target, held-out", result.held_out),
        *((f"target, judged by {judge.classifier}", judge.target) for judge in result.judges),
    ]
    for name, accuracy in rows:
        if accuracy is not None:
            shares = (accuracy.a_before, accuracy.a_after, accuracy.a_drop)
            interval = accuracy.a_drop_interval
            ends = f"{interval[0]:.2f} to {interval[1]:.2f}" if interval else "n.a."
            yield {"name": name, "views": accuracy.views, "cells": [*map(_share, shares), ends]}


def _share(value: float | None) -> str:
    return "n.a." if value is None else f"{value:.2f}"


def _measures(result: Result) -> Iterable[dict[str, str]]:
    if result.light:
        yield {"name": "Light that was found", "value": _light(result.light), "help": LightFound.__doc__ or ""}
    if result.vertices:
        moved = f"{1000 * result.vertices.largest:.2g} mm, {result.vertices.largest_share:.1%} of the radius"
        yield {"name": "Largest move of a vertex", "value": moved, "help": VerticesMoved.__doc__ or ""}
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


OPTIONS: Final = {"judges": "judge", "materials": "material", "target_label": "target"}
"""Fields of a spec whose option of ``trompe attack`` is not called as they are."""
PAIRS: Final = {"elevation"}


def command(spec: JobSpec, *, object: str, classifier: str) -> str:
    """The command line that asks for the same job: what differs from the defaults. Masks stay on the server."""
    words = ["trompe", "attack", object, "--label", str(spec.label), "--classifier", classifier]
    plain = JobSpec.model_validate(spec.model_dump(include={"object", "label", "classifier", "epsilon"}))
    for field in JobSpec.model_fields:
        value = getattr(spec, field)
        if field in {"object", "label", "classifier", "masks", "ranges", "sun"} or value == getattr(plain, field):
            continue
        option = f"--{OPTIONS.get(field, field).replace('_', '-')}"
        if field in PAIRS:
            words += [option, *(f"{end:g}" for end in value)]
        else:
            for each in value if isinstance(value, list) else [value]:
                words += [option, f"{each:g}" if isinstance(each, float) else str(each)]
    if spec.epsilon != JobSpec.model_fields["epsilon"].default:
        words += ["--epsilon", f"{spec.epsilon:g}"]
    for option, given in {"--range": spec.ranges, "--sun": spec.sun}.items():
        for name, (low, high) in given.model_dump(exclude={"light_colours"}, exclude_defaults=True).items():
            words += [option, name, f"{low:g}", f"{high:g}"]
    return shlex.join([*words, "--out", "result"])


def differences(asked: Sequence[Mapping[str, Any]], results: Sequence[Result]) -> list[dict[str, Any]]:
    """What was asked and what came out of two jobs, line by line."""
    lines = [{"name": name, "cells": [value_text(options[name]) for options in asked]} for name in asked[0]]
    for field, title in {"target": "target", "held_out": "held-out"}.items():
        judged: list[Accuracy | None] = [getattr(side, field) for side in results]
        drops = [each.a_drop if each else None for each in judged]
        lines.append({"name": f"A_drop, {title}", "cells": [_share(drop) for drop in drops]})
    for field, name in MEASURES.items():
        lines.append({"name": name, "cells": [value_text(getattr(side, field)) for side in results]})
    seconds = [sum(side.seconds.values()) for side in results]
    lines.append({"name": "seconds", "cells": [f"{took:.1f}" for took in seconds]})
    return [line | {"differs": line["cells"][0] != line["cells"][1]} for line in lines]


def value_text(value: Any) -> str:
    """An option or a figure in a few characters; a dash where there is none."""
    if value is None or value in ([], {}):
        return "–"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {value_text(each)}" for name, each in value.items())
    if isinstance(value, (list, tuple)):
        return " ".join(value_text(each) for each in value)
    return str(value)
