"""Tables of results, jobs and stored things for a terminal."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trompe_shared.api import (
    AS_RENDERED,
    Accuracy,
    BackgroundInfo,
    ClassifierInfo,
    Job,
    JobSpec,
    JudgementSpec,
    Manifest,
    ObjectInfo,
    RendererInfo,
    Result,
    WorkerInfo,
    in_flags,
)

PERCENT: Final = "{:.1%}"
NARROWEST: Final = 8
"""Width of a column of words."""
LEVELS: Final = "{:.4f} ({levels:.1f}/255)"


def spent(result: Result, job: Job, *, start_up: float = 0.0, wall: float | None = None) -> dict[str, float]:
    """Seconds from start to end, by what they went to: the queue, then the parts of the job.

    wall: seconds of the command that submitted the job, with its files on disk; ``start_up``: those until the job was
    submitted. Both are accounted for too, so that the sum is ``wall``.
    """
    if job.started is None or job.finished is None:
        return result.seconds
    queue, run = ((job.started - job.created).total_seconds(), (job.finished - job.started).total_seconds())
    parts = {"queue": queue, **result.seconds}
    parts["open"] = parts.get("open", 0.0) + max(0.0, run - sum(result.seconds.values()))
    if wall is None or wall < queue + run:  # the job is older than the command
        return parts
    return {"start-up": start_up} | parts | {"download": max(0.0, wall - start_up - sum(parts.values()))}


def result_report(
    result: Result, *, note: str | None = None, seconds: Mapping[str, float] | None = None
) -> RenderableType:
    """Accuracies before and after, size of the change, and cost of the attack. ``seconds`` default to the job's own."""
    table = empty_table("", "views", "A_before", "A_after", "A_drop", right=4)
    for name, accuracy in result.accuracies:
        table.add_row(name, accuracy.counted, *_cells(accuracy))
    facts = _pairs(_facts(result, seconds or result.seconds))
    notes = [Text(f"n.a.: {in_flags(note)}", style="yellow")] if note else []
    warnings = [Text(f"warning: {in_flags(each)}", style="yellow") for each in result.warnings if each != note]
    return Group(Text(_headline(result), style="bold"), table, Text("[..] intervals at 95 %"), facts, *notes, *warnings)


def judgement_report(manifest: Manifest, files: Sequence[Path]) -> RenderableType:
    """Figures of the images as rendered, and the findings. files: what was written."""
    table = empty_table("network", "renderer", "before", "after", "A_drop", right=3)
    for cell in manifest.cells:
        if cell.pipeline == AS_RENDERED:
            figures = ["", "", "missing"] if cell.accuracy is None else _cells(cell.accuracy)
            table.add_row(cell.network, cell.renderer, *figures)
    findings = [Text(f"- {in_flags(finding.text)}") for finding in manifest.findings]
    return Group(table, Text("[..] intervals at 95 %"), *findings, Text(f"written: {', '.join(map(str, files))}"))


def jobs_table(jobs: Sequence[Job]) -> Table:
    """One line per job, with a column of labels if there are any."""
    labels = ["labels"] if any(job.labels for job in jobs) else []
    table = empty_table("job", "state", "object", "label", "classifier", "epsilon", "done", "created", *labels)
    table.columns[0].no_wrap = True  # ids are copied
    for job in jobs:
        what = _judged(job, job.spec) if isinstance(job.spec, JudgementSpec) else _attacked(job, job.spec)
        how = [f"{job.progress.fraction:.0%}", f"{job.created:%Y-%m-%d %H:%M}"]
        table.add_row(job.id, job.state.value, *what, *how, *([_words(job.labels)] if labels else []))
    return table


def _attacked(job: Job, spec: JobSpec) -> list[str]:
    object, classifier = (_short(_named(each, job)) for each in (spec.object, spec.victim.classifier))
    return [object, _either(spec.goal.label), classifier, f"{spec.paint.epsilon:g}"]


def _judged(job: Job, spec: JudgementSpec) -> list[str]:
    objects = " to ".join(_short(_named(each, job)) for each in (spec.before, spec.after))
    networks = ", ".join(_short(_named(each, job)) for each in spec.networks) or spec.suite or "tiny"
    return [f"judge {objects}", _either(spec.label), networks, _figure(spec.epsilon, "{:g}")]


def job_table(job: Job) -> Table:
    """State of a job, and its options that differ from the defaults."""
    return _pairs((name, value) for name, value in _job_facts(job) if value)


def _pairs(facts: Iterable[tuple[str, str]]) -> Table:
    """Names and values, a line each."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for fact in facts:
        table.add_row(*fact)
    return table


def _job_facts(job: Job) -> Iterator[tuple[str, str]]:
    yield "job", job.id
    yield "state", f"{job.state.value}, {job.progress.phase}, {job.progress.fraction:.0%}"
    yield "error", in_flags(job.error or "")
    yield "note", in_flags(job.note or "")
    for name, value in _asked(job.spec).items():
        yield name, _named(", ".join(map(str, value)) if isinstance(value, list) else value, job)
    yield "ids", " ".join(f"{name}={identity}" for identity, name in job.names.items())
    yield "labels", _words(job.labels)
    yield "priority", f"{job.priority}, needs {job.needs}"
    yield "attempts", f"{job.attempts}, worker {job.worker or 'none yet'}"
    for name in ("created", "started", "finished"):
        time = getattr(job, name)
        yield name, f"{time:%Y-%m-%d %H:%M:%S %Z}" if time else ""
    yield "files", ", ".join(job.artifacts)


def _asked(spec: JobSpec | JudgementSpec) -> dict[str, Any]:
    """Options that differ from their defaults."""
    if isinstance(spec, JudgementSpec):
        return spec.model_dump(exclude_defaults=True)
    return {"object": spec.object} | spec.changed()


def records_table(kind: type, records: Sequence[Any]) -> Table:
    """One line per record of a kind: ``ObjectInfo``, ``ClassifierInfo``, ``BackgroundInfo`` and so on."""
    columns, cells = _RECORDS[kind]
    table = empty_table(*columns)
    for record in records:
        table.add_row(*cells(record))
    return table


def _object_cells(obj: ObjectInfo) -> list[str]:
    textures = ", ".join(f"{file} {width}x{height}" for file, (height, width) in obj.textures.items())
    return [obj.name, _short(obj.id), str(obj.triangles), textures, f"{obj.radius:.3g} m", _origin(obj.shipped)]


def _classifier_cells(one: ClassifierInfo) -> list[str]:
    use = "attack, judge" if one.white_box else "judge, attack by scores"
    height, width = one.image_size
    return [one.name, _short(one.id), use, f"{width}x{height}", str(one.n_classes), _origin(one.shipped)]


def _worker_cells(one: WorkerInfo) -> list[str]:
    times = [f"{time:%Y-%m-%d %H:%M:%S}" for time in (one.started, one.seen)]
    return [one.id, one.host, one.device, _yes(one.alive), one.fault or " ".join(one.jobs), *times]


_RECORDS: Final[Mapping[type, tuple[Sequence[str], Callable[[Any], Sequence[str]]]]] = {
    ObjectInfo: (("name", "id", "triangles", "textures", "radius", "origin"), _object_cells),
    ClassifierInfo: (("name", "id", "use", "input", "classes", "origin"), _classifier_cells),
    BackgroundInfo: (("name", "id"), lambda one: (one.name, one.id)),
    WorkerInfo: (("worker", "host", "device", "alive", "jobs", "started", "seen"), _worker_cells),
    RendererInfo: (("renderer", "alive", "engine"), lambda one: (one.address, _yes(one.alive), one.identity or "")),
}


def empty_table(*columns: str, right: int = 0) -> Table:
    """A table with numbers in the last ``right`` columns: aligned right and never wrapped. Others keep ``NARROWEST``,
    even if the table then is wider than the terminal."""
    table = Table()
    for index, name in enumerate(columns):
        if index < len(columns) - right:
            table.add_column(name, overflow="fold", min_width=NARROWEST)
        else:
            table.add_column(name, justify="right", no_wrap=True)
    return table


def _headline(result: Result) -> str:
    spec = result.spec
    names = result.label_names or []
    label = _either([f"{name} ({k})" for name, k in zip(names, result.labels, strict=False)] or result.labels)
    tau = "none" if result.tau is None else f"{result.tau:g}"
    others = [("epsilon_view", spec.paint.epsilon_view), ("keep", spec.paint.keep)]
    given = "".join(f", {name} {value:g}" for name, value in others if value is not None)
    budget = f"epsilon {result.epsilon:g}, alpha {result.alpha:g}, tau {tau}{given}"
    through = " and ".join([result.classifier, *map(_short, spec.victim.ensemble)])
    return (
        f"{result.object}, class {label}, attacked through {through}: {budget}, {result.steps} steps, "
        f"seed {result.seed}"
    )


def _cells(accuracy: Accuracy) -> list[str]:
    before = _with_interval(accuracy.a_before, accuracy.a_before_interval)
    after = _with_interval(accuracy.a_after, accuracy.a_after_interval)
    return [before, after, _with_interval(accuracy.a_drop, accuracy.a_drop_interval)]


def _with_interval(share: float | None, interval: tuple[float, float] | None) -> str:
    return _figure(share) + (f" [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else "")


def _facts(result: Result, seconds: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    if result.drawn_by:
        yield "renderer", result.drawn_by
    if result.at_goal:
        yield "goal reached", result.at_goal
    if result.fooled_as:
        yield "fooled views became", result.became
    yield "N% (texels altered)", _figure(result.texels_altered, PERCENT)
    yield "mean texel change", _figure(result.mean_texel_change, LEVELS)
    yield "max view change", _figure(result.max_view_change, LEVELS)
    if result.views_beyond_epsilon is not None and result.pixels_beyond_epsilon is not None:
        views, pixels = _figure(result.views_beyond_epsilon, PERCENT), f"{result.pixels_beyond_epsilon:.2%}"
        name = "epsilon" if result.spec.paint.epsilon_view is None else "epsilon_view"
        bounded = {"epsilon": "texels", "epsilon_view": "the surrogate's views"}[name]
        yield f"above {name}", f"{views} of the target views ({pixels} of the object's pixels); {name} bounds {bounded}"
    if result.ssim is not None and result.noticed is not None:
        yield "visibility", f"{result.noticed} SSIM {result.ssim:.3f}"
    for name, each in result.by_renderer:
        if each.surrogate_model:
            yield f"{name}surrogate model", f"{each.surrogate_model}: {each.surrogate_reason}"
    differ = "" if result.disagreement is None else f"; they disagree on {result.disagreement:.1%} of the own views"
    yield "transfer gap", f"{_figure(result.transfer_gap)}{differ}"
    parts = ", ".join(f"{part} {took:.1f}" for part, took in seconds.items())
    yield "seconds", f"{sum(seconds.values()):.1f}: {parts}"
    added = result.attacked_views - len(result.views)
    yield "attacked views", f"{result.attacked_views}" + (f", {added} of them added where it lost" if added > 0 else "")
    yield "probe renders", f"{result.probe_renders}, and {result.further_renders} to find views to add"
    if result.evaluations is not None:
        queries = "" if result.queries is None else f", {result.queries:,} scores asked"
        yield "images evaluated", f"{result.evaluations:,} by each attacked classifier{queries}"


def _figure(value: float | None, form: str = "{:.2f}") -> str:
    return "n.a." if value is None else form.format(value, levels=value * 255)


def _either(labels: Iterable[object]) -> str:
    return " or ".join(map(str, labels))


def _short(reference: str) -> str:
    """A name, or the first 12 digits of an id, which identify it too."""
    return reference[:12] if re.fullmatch("[0-9a-f]{32,}", reference) else reference


def _named(value: Any, job: Job) -> str:
    """An option's value with names in place of ids."""
    text = str(value)
    for identity, name in job.names.items():
        text = text.replace(identity, name)
    return text


def _origin(shipped: bool) -> str:
    return "shipped" if shipped else "uploaded"


def _yes(true: bool) -> str:
    return "yes" if true else "no"


def _words(labels: Mapping[str, str]) -> str:
    return " ".join(f"{name}={value}" for name, value in labels.items())
