"""Jobs of an experiment, each with a key that is the same at every run."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from trompe_client._plan import AttackPlan, Read, Upload, plan_attack, source_of
from trompe_experiments.asset_objects import asset_objects
from trompe_experiments.design import AssetsFolder, Experiment, expanded
from trompe_experiments.table import RowId, job_key
from trompe_shared.api import JobRequest, JudgementRequest
from trompe_shared.comparison import grouped
from trompe_shared.errors import ObjectError, SpecError
from trompe_shared.local_files import CLASSIFIER_SUFFIXES, LOOKED_UP, PICTURE_SUFFIXES
from trompe_shared.presets import with_preset
from trompe_shared.shipped import shipped_objects

LABEL, CASE = "experiment", "case"
"""Labels of an experiment's jobs."""
FILE_SUFFIXES: Final = {*CLASSIFIER_SUFFIXES, *PICTURE_SUFFIXES}

Options = Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """One job. ``object`` is the object's name for people. Equal jobs of several series have the same key."""

    place: RowId
    object: str
    attack: AttackPlan = field(repr=False)

    @property
    def key(self) -> str:
        """Idempotency key; see ``job_key``."""
        return self.place.key

    @property
    def request(self) -> JobRequest:
        """The job, with file names in place of files."""
        return self.attack.request({})

    @property
    def network(self) -> Upload | str:
        """The attacked network."""
        found: Upload | str = self.attack.options.get("classifier", self.request.victim.classifier)
        return found

    def judgement(self, options: Options, *, before: str, after: str, network: str) -> JudgementRequest:
        """A judgement with the job's label, budget, cameras and background. Raises ``SpecError``."""
        asked = self.request
        return JudgementRequest.of(
            before,
            after,
            label=asked.goal.label,
            networks=[network],
            epsilon=asked.paint.epsilon,
            distance=asked.views.distance,
            elevation=asked.views.elevation,
            background=asked.views.background[0],
            priority="sweep",
            **options,
        )


@dataclass(frozen=True)
class Plan:
    """All rows of an experiment, in the order of their jobs."""

    experiment: Experiment
    rows: tuple[Row, ...]

    def jobs(self) -> dict[str, Row]:
        """The first row of each distinct job, by key."""
        found: dict[str, Row] = {}
        for row in self.rows:
            found.setdefault(row.key, row)
        return found


def plan_experiment(experiment: Experiment) -> Plan:
    """Read the named files and check every job before any request.

    Raises ``SpecError``, ``ObjectError`` or ``ClassifierError``.
    """
    files = _Files(experiment.folder)
    objects = dict(_objects(experiment, files))
    cases: dict[str, Options] = dict(experiment.cases) or {"": {}}
    rows = []
    for grid in experiment.grid:
        series = " x ".join(grid) if len(experiment.grid) > 1 else ""
        combinations = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
        for name, chosen, (case, variation) in product(objects, combinations, cases.items()):
            configuration = ", ".join([*([case] if case else []), *(f"{k} {word(v)}" for k, v in chosen.items())])
            place = RowId(experiment=experiment.name, key="", series=series, case=case, configuration=configuration)
            options = dict(experiment.base) | objects[name] | with_preset(chosen) | dict(variation)
            seeds = options.pop("seeds", experiment.seeds)
            rows += [_row(place, name, options | {"seed": seed}, files) for seed in seeds]
    if experiment.judgement is not None:
        for name, own in grouped(rows, lambda row: row.object).items():
            _check_judgement(name, own, experiment.judgement)
    return Plan(experiment, tuple(rows))


def _check_judgement(name: str, rows: Sequence[Row], options: Options) -> None:
    """Raises ``SpecError`` if the jobs of an object cannot be judged, all by one judgement."""
    if len({row.network for row in rows}) > 1:
        raise SpecError(
            f"The judgement of {name} needs one `classifier` for all its jobs: give it in `base` or of the object."
        )
    given = rows[0].attack.options["object"]
    if not isinstance(given, Upload) and given not in shipped_objects():
        raise SpecError(f"A judgement needs the file of {name} for its noise: give it as `file`.")
    try:
        rows[0].judgement(options, before=name, after=name, network="tiny")
    except SpecError as error:
        raise SpecError(f"The judgement of {name}: {error}") from error


def word(value: Any) -> str:
    """A value for legends."""
    if value is None:
        return "none"
    if isinstance(value, list | tuple):
        return " + ".join(map(word, value))
    if isinstance(value, BaseModel):
        return str(value.model_dump(exclude_defaults=True))
    if isinstance(value, float):
        return f"{value:.3g}"
    return name_of(str(value))


def name_of(source: str) -> str:
    """The name of a file without folder and suffix; any other word as it is."""
    return Path(source).stem if _is_file(source) else source


def _is_file(source: str) -> bool:
    return Path(source).suffix.lower() in FILE_SUFFIXES and not source.startswith(LOOKED_UP)


def _row(place: RowId, name: str, options: Options, files: "_Files") -> Row:
    labels = {LABEL: place.experiment} | ({CASE: place.case} if place.case else {})
    try:
        attack = plan_attack(**{"priority": "sweep", **options, "labels": labels}, read=files.read)
    except SpecError as error:
        raise SpecError(f"Job {name}, {place.configuration or 'base'}: {error}") from error
    spec = attack.request({upload: files.sha256(upload) for upload in attack.uploads()}).spec()
    key = job_key(place.experiment, spec, *([place.case] if place.case else []))
    return Row(place.model_copy(update={"key": key}), name, attack)


def _objects(experiment: Experiment, files: "_Files") -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and options of each object."""
    given = experiment.objects
    if given == "shipped":
        yield from ((name, {"object": name, "label": each.label}) for name, each in shipped_objects().items())
    elif isinstance(given, AssetsFolder):
        yield from _of_assets(given, files)
    else:
        assert isinstance(given, dict)
        for name, options in given.items():
            others = dict(options)
            path = others.pop("file", None)
            own = shipped_objects().get(name)
            if own is None and "label" not in {**experiment.base, **others}:
                known = ", ".join(shipped_objects())
                raise SpecError(f"`objects`: {name!r} needs a `label`, as it is none of the shipped objects ({known}).")
            label = {"label": own.label} if own is not None else {}
            yield name, {"object": files.path(path) if path else name} | label | others


def _of_assets(given: AssetsFolder, files: "_Files") -> Iterator[tuple[str, dict[str, Any]]]:
    folder = files.path(given.assets)
    table = asset_objects(folder)
    unknown = sorted(set(given.only) - set(table))
    if unknown:
        raise ObjectError(f"No {', '.join(unknown)} in {str(folder / 'objects')!r}; objects: {', '.join(table)}.")
    for name in given.only or table:
        each = table[name]
        seen = {"label": each.label, "distance": each.distance, "elevation": each.elevation}
        yield name, {"object": each.path, "background": each.background} | seen


class _Files:
    """Reads and hashes each named file once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.read: Read = cache(self._read)
        self.sha256 = cache(Upload.sha256)

    def path(self, text: str) -> Path:
        """A path of the experiment's file: relative to its folder, after a variable to the working folder."""
        return (Path.cwd() if text.startswith("$") else self._folder) / expanded(text)

    def _read(self, kind: str, source: str | Path) -> Upload | str:
        """See ``trompe_client._plan.Read``. Objects are names unless they are paths."""
        is_file = isinstance(source, Path) or kind == "mask" or _is_file(str(source))
        return source_of(kind, self.path(str(source))) if is_file else str(source)
