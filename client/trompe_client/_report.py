"""A result as a table for people."""

from collections.abc import Iterator, Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trompe_shared.api import (
    Accuracy,
    BackgroundInfo,
    ClassifierInfo,
    Job,
    JobSpec,
    ObjectInfo,
    RendererInfo,
    Result,
    WorkerInfo,
)

__all__ = [
    "backgrounds_table",
    "classifiers_table",
    "job_table",
    "jobs_table",
    "objects_table",
    "renderers_table",
    "result_report",
    "workers_table",
]


def result_report(result: Result, *, note: str | None = None) -> RenderableType:
    """Accuracies before and after, then how large the change is and how the figures came about."""
    table = _table("", "views", "A_before", "A_after", "A_drop", right=4)
    for name, accuracy in _rows(result):
        table.add_row(name, str(accuracy.views), *_cells(accuracy))
    facts = Table.grid(padding=(0, 2))
    facts.add_column(no_wrap=True)
    facts.add_column()
    for name, value in _facts(result):
        facts.add_row(name, value)
    notes = [Text(f"n.a.: {note}", style="yellow")] if note else []
    warnings = [Text(f"warning: {warning}", style="yellow") for warning in result.warnings]
    return Group(Text(_headline(result), style="bold"), table, Text("[..] intervals at 95 %"), facts, *notes, *warnings)


def jobs_table(jobs: Sequence[Job]) -> Table:
    """One line per job; those with labels say them."""
    labels = ["labels"] if any(job.labels for job in jobs) else []
    table = _table("job", "state", "object", "label", "classifier", "epsilon", "done", "created", *labels)
    for job in jobs:
        spec = job.spec
        what = [_short(spec.object), str(spec.label), _short(spec.classifier), _budget(spec)]
        how = [f"{job.progress.fraction:.0%}", f"{job.created:%Y-%m-%d %H:%M}"]
        table.add_row(job.id, job.state.value, *what, *how, *([_words(job.labels)] if labels else []))
    return table


def job_table(job: Job) -> Table:
    """All that is known of one job; of what was asked for, what is not the default."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in _job_facts(job):
        if value:
            table.add_row(name, value)
    return table


def _job_facts(job: Job) -> Iterator[tuple[str, str]]:
    yield "job", job.id
    yield "state", f"{job.state.value}, {job.progress.phase}, {job.progress.fraction:.0%}"
    yield "error", job.error or ""
    yield "note", job.note or ""
    for name, value in job.spec.model_dump(exclude_defaults=True).items():
        yield name, str(value)
    yield "labels", _words(job.labels)
    yield "priority", f"{job.priority}, needs {job.needs}"
    yield "attempts", f"{job.attempts}, worker {job.worker or 'none yet'}"
    for name in ("created", "started", "finished"):
        time = getattr(job, name)
        yield name, f"{time:%Y-%m-%d %H:%M:%S %Z}" if time else ""
    yield "files", ", ".join(job.artifacts)


def workers_table(workers: Sequence[WorkerInfo]) -> Table:
    """One line per attack worker."""
    table = _table("worker", "host", "device", "alive", "job", "started", "seen")
    for one in workers:
        times = [f"{time:%Y-%m-%d %H:%M:%S}" for time in (one.started, one.seen)]
        table.add_row(one.id, one.host, one.device, _yes(one.alive), one.job or "", *times)
    return table


def renderers_table(renderers: Sequence[RendererInfo]) -> Table:
    """One line per renderer worker."""
    table = _table("renderer", "alive")
    for one in renderers:
        table.add_row(one.address, _yes(one.alive))
    return table


def backgrounds_table(backgrounds: Sequence[BackgroundInfo]) -> Table:
    """One line per uploaded picture."""
    table = _table("name", "id")
    for one in backgrounds:
        table.add_row(one.name, one.id)
    return table


def objects_table(objects: Sequence[ObjectInfo]) -> Table:
    """One line per stored object."""
    table = _table("name", "id", "triangles", "textures", "radius", "origin")
    for obj in objects:
        textures = ", ".join(f"{file} {width}x{height}" for file, (height, width) in obj.textures.items())
        table.add_row(
            obj.name, _short(obj.id), str(obj.triangles), textures, f"{obj.radius:.3g} m", _origin(obj.shipped)
        )
    return table


def classifiers_table(classifiers: Sequence[ClassifierInfo]) -> Table:
    """One line per stored classifier."""
    table = _table("name", "id", "use", "input", "classes", "origin")
    for one in classifiers:
        use = "attack, judge" if one.white_box else "judge, attack by scores"
        height, width = one.image_size
        table.add_row(one.name, _short(one.id), use, f"{width}x{height}", str(one.n_classes), _origin(one.shipped))
    return table


def _table(*columns: str, right: int = 0) -> Table:
    """A table; the last ``right`` columns hold numbers: they are aligned to the right and keep to one line."""
    table = Table()
    for index, name in enumerate(columns):
        number = index >= len(columns) - right
        table.add_column(name, justify="right" if number else "left", overflow="fold", no_wrap=number)
    return table


def _headline(result: Result) -> str:
    label = f"{result.label_name} ({result.label})" if result.label_name else str(result.label)
    scope = "" if result.spec.saliency_scope == "all_views" else " in each view"
    tau = "none" if result.tau is None else f"{result.tau:g}{scope}"
    keep = "" if result.spec.keep is None else f", keep {result.spec.keep:g}"
    budget = f"epsilon {result.epsilon:g}, alpha {result.alpha:g}, tau {tau}{keep}"
    what = budget if result.spec.attack_on == "texture" else result.spec.attack_on
    numbers = f"{what}, {result.steps} steps, seed {result.seed}"
    through = " and ".join([result.classifier, *(_short(member) for member in result.spec.ensemble)])
    return f"{result.object}, class {label}, attacked through {through}: {numbers}"


def _rows(result: Result) -> Iterator[tuple[str, Accuracy]]:
    rows = [
        ("surrogate (own views)", result.surrogate),
        ("target (own views)", result.target),
        ("target (held-out views)", result.held_out),
    ]
    for judge in result.judges:
        rows += [
            (f"judge {judge.classifier} (own views)", judge.target),
            (f"judge {judge.classifier} (held-out views)", judge.held_out),
        ]
    return ((name, accuracy) for name, accuracy in rows if accuracy is not None)


def _cells(accuracy: Accuracy) -> list[str]:
    before = _with_interval(accuracy.a_before, accuracy.a_before_interval)
    after = _with_interval(accuracy.a_after, accuracy.a_after_interval)
    return [before, after, _with_interval(accuracy.a_drop, accuracy.a_drop_interval)]


def _with_interval(share: float | None, interval: tuple[float, float] | None) -> str:
    return _number(share) + (f" [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else "")


def _facts(result: Result) -> Iterator[tuple[str, str]]:
    if result.goal_reached is not None and (result.spec.target_label is not None or result.spec.top_k > 1):
        yield "goal reached", f"{_percent(result.goal_reached)} of the target views: {_goal(result.spec)}"
    yield from _changed(result)
    yield "max view change", _levels(result.max_view_change)
    if result.views_beyond_epsilon is not None and result.pixels_beyond_epsilon is not None:
        views, pixels = _percent(result.views_beyond_epsilon), f"{result.pixels_beyond_epsilon:.2%}"
        yield "beyond epsilon", f"{views} of the target views ({pixels} of the object's pixels)"
    if result.ssim is not None and result.delta_e is not None:
        yield "what people see", f"SSIM {result.ssim:.3f}, colour difference (CIEDE2000) {result.delta_e:.2f}"
    yield "surrogate model", f"{result.surrogate_model}: {result.surrogate_reason}"
    yield "transfer gap", _number(result.transfer_gap)
    yield "seconds", ", ".join(f"{phase} {seconds:.1f}" for phase, seconds in result.seconds.items())
    yield "probe renders", str(result.probe_renders)
    if result.evaluations is not None:
        asked = "" if result.queries is None else f", {result.queries:,} scores asked"
        yield "images evaluated", f"{result.evaluations:,} by each attacked classifier{asked}"


def _changed(result: Result) -> Iterator[tuple[str, str]]:
    """What the attack changed of texels, light or vertices."""
    light, vertices = result.light, result.vertices
    if result.spec.attack_on == "texture":
        yield "N% (texels altered)", _percent(result.texels_altered)
        yield "mean texel change", _levels(result.mean_texel_change)
    if light is not None:
        place = {name: getattr(light, name) for name in ("azimuth", "elevation", "intensity", "ambient")}
        words = ", ".join(f"{name} {value:.3g}" for name, value in place.items() if value is not None)
        yield "light found", f"{words}; fooled {_percent(light.fooled)} of {light.tried_on} views that judge nothing"
    if vertices is not None:
        largest, mean = (f"{1000 * metres:.3g} mm" for metres in (vertices.largest, vertices.mean))
        yield "vertices moved", f"at most {largest} ({vertices.largest_share:.1%} of the radius), {mean} on average"


def _budget(spec: JobSpec) -> str:
    """Epsilon, or what else may change."""
    return f"{spec.epsilon:g}" if spec.attack_on == "texture" else spec.attack_on


def _goal(spec: JobSpec) -> str:
    if spec.target_label is None:
        return f"the true class is not among the {spec.top_k} best"
    return f"taken for {spec.target_label if isinstance(spec.target_label, str) else f'class {spec.target_label}'}"


def _number(value: float | None) -> str:
    return "n.a." if value is None else f"{value:.2f}"


def _percent(share: float | None) -> str:
    return "n.a." if share is None else f"{share:.1%}"


def _levels(change: float | None) -> str:
    return "n.a." if change is None else f"{change:.4f} ({change * 255:.1f}/255)"


def _short(reference: str) -> str:
    """A name as it is; of an id, which is a long hash, the beginning, which the server takes as well."""
    return reference if len(reference) < 32 else reference[:12]


def _origin(shipped: bool) -> str:
    return "shipped" if shipped else "uploaded"


def _yes(true: bool) -> str:
    return "yes" if true else "no"


def _words(labels: Mapping[str, str]) -> str:
    return " ".join(f"{name}={value}" for name, value in labels.items())
