"""From the file of an experiment to its jobs, each with a key that stays the same however often it is run."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import ValidationError

from trompe_client._plan import (
    CLASSIFIER_SUFFIXES,
    PICTURE_SUFFIXES,
    Upload,
    background_source,
    classifier_source,
    object_upload,
)
from trompe_client.experiments.design import AssetsFolder, Experiment, expanded
from trompe_shared.api import JobRequest
from trompe_shared.asset_objects import asset_objects
from trompe_shared.errors import ObjectError, SpecError
from trompe_shared.experiment_table import RowId, job_key
from trompe_shared.faults import faults_of
from trompe_shared.presets import PRESETS
from trompe_shared.shipped import shipped_objects

__all__ = ["LABEL", "Plan", "Row", "plan_experiment"]

LABEL: Final = "experiment"
"""The label that an experiment's jobs carry."""

Fields = Mapping[str, Any]
Kind = Literal["object", "classifier", "background"]

NAMING: Final[Mapping[str, Kind]] = {
    "object": "object",
    "classifier": "classifier",
    "ensemble": "classifier",
    "judges": "classifier",
    "background": "background",
}
"""Fields of a job that may name files."""


@dataclass(frozen=True)
class File:
    """A file that the server must have before a job can name it."""

    kind: Kind
    upload: Upload


@dataclass(frozen=True)
class Row:
    """One job. Files are named in ``request`` by the SHA-256 of their bytes; ``uploads`` has them, by that name.

    ``object`` is the object's name for people. Rows of several series that ask the same have the same key.
    """

    place: RowId
    object: str
    request: JobRequest
    uploads: Mapping[str, File] = field(repr=False)

    @property
    def key(self) -> str:
        """The idempotency key; see ``job_key``."""
        return self.place.key

    def stored(self, ids: Mapping[str, str]) -> JobRequest:
        """The request with the ids that the server gave the uploads, ``ids`` by their SHA-256."""
        named = self.request.model_dump()
        for name in ("object", "classifier"):
            named[name] = ids.get(named[name], named[name])
        for name in ("ensemble", "judges", "background"):
            named[name] = [ids.get(each, each) for each in named[name]]
        return JobRequest.model_validate(named)


@dataclass(frozen=True)
class Plan:
    """All rows of an experiment, in the order in which they run."""

    experiment: Experiment
    rows: tuple[Row, ...]

    def jobs(self) -> dict[str, Row]:
        """A row for each distinct job, by key."""
        found: dict[str, Row] = {}
        for row in self.rows:
            found.setdefault(row.key, row)
        return found


def plan_experiment(experiment: Experiment) -> Plan:
    """Read the files that are named and check every job, before any server is asked.

    Raises ``SpecError``, ``ObjectError`` or ``ClassifierError``.
    """
    files = _Files(experiment.folder)
    objects = dict(_objects(experiment, files))
    cases: dict[str, Fields] = dict(experiment.cases) or {"": {}}
    rows = []
    for grid in experiment.grid:
        series = " x ".join(grid) if len(experiment.grid) > 1 else ""
        combinations = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
        for name, chosen, (case, variation) in product(objects, combinations, cases.items()):
            configuration = ", ".join([*([case] if case else []), *(f"{k} {_word(v)}" for k, v in chosen.items())])
            place = RowId(experiment=experiment.name, key="", series=series, case=case, configuration=configuration)
            fields = dict(experiment.base) | objects[name] | _with_preset(chosen) | dict(variation)
            seeds = fields.pop("seeds", experiment.seeds)
            rows += [_row(place, name, fields | {"seed": seed}, files) for seed in seeds]
    return Plan(experiment, tuple(rows))


def _with_preset(chosen: Fields) -> dict[str, Any]:
    """The fields of a combination; a preset stands for its own, which the others win over."""
    preset = chosen.get("preset")
    if preset is not None and preset not in PRESETS:
        raise SpecError(f"There is no preset {preset!r}; there are {', '.join(PRESETS)}.")
    own = {name: value for name, value in chosen.items() if name != "preset"}
    return (dict(PRESETS[preset].options) if preset else {}) | own


def _word(value: Any) -> str:
    """A value as a figure's legend shows it."""
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.3g}"
    return Path(value).stem if isinstance(value, str) else str(value)


def _row(place: RowId, name: str, fields: Fields, files: "_Files") -> Row:
    uploads: dict[str, File] = {}
    named = files.by_hash(fields, uploads)
    named["labels"] = {LABEL: place.experiment}
    try:
        request = JobRequest.model_validate({"priority": "sweep"} | named)
    except ValidationError as error:
        wrong = "; ".join(map(str, faults_of(error)))
        raise SpecError(f"The job {name}, {place.configuration or 'base'}, cannot be: {wrong}.") from error
    key = job_key(place.experiment, request.spec())
    return Row(place.model_copy(update={"key": key}), name, request, uploads)


def _objects(experiment: Experiment, files: "_Files") -> Iterator[tuple[str, dict[str, Any]]]:
    """Each object's name and fields."""
    given = experiment.objects
    if given == "shipped":
        yield from ((name, {"object": name, "label": each.label}) for name, each in shipped_objects().items())
    elif isinstance(given, AssetsFolder):
        yield from _of_assets(given, files)
    else:
        assert isinstance(given, dict)
        for name, fields in given.items():
            row = dict(fields)
            path = row.pop("file", None)
            own = shipped_objects().get(name)
            label = {"label": own.label} if own is not None else {}
            yield name, {"object": files.path(path) if path else name} | label | row


def _of_assets(given: AssetsFolder, files: "_Files") -> Iterator[tuple[str, dict[str, Any]]]:
    folder = files.path(given.assets)
    table = asset_objects(folder)
    unknown = sorted(set(given.only) - set(table))
    if unknown:
        raise ObjectError(f"{str(folder / 'objects')!r} has no {', '.join(unknown)}; there are {', '.join(table)}.")
    for name in given.only or table:
        each = table[name]
        seen = {"label": each.label, "distance": each.distance, "elevation": each.elevation}
        yield name, {"object": each.path, "background": each.background} | seen


class _Files:
    """Reads each file that is named once, and names it by its SHA-256."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[tuple[Kind, str], tuple[str, File | None]] = {}

    def path(self, text: str) -> Path:
        """Where a path of the experiment's file leads."""
        return self._folder / expanded(text)

    def by_hash(self, fields: Fields, uploads: dict[str, File]) -> dict[str, Any]:
        """``fields`` with hashes in place of paths; what they stand for goes into ``uploads``."""

        def named(kind: Kind, source: str | Path) -> str:
            name, file = self._source(kind, source)
            if file is not None:
                uploads[name] = file
            return name

        result = dict(fields)
        for name, kind in NAMING.items():
            given = fields.get(name)
            if isinstance(given, list):
                result[name] = [named(kind, each) for each in given]
            elif given is not None:
                result[name] = named(kind, given)
        return result

    def _source(self, kind: Kind, source: str | Path) -> tuple[str, File | None]:
        """The name that a job gives a source, and the file behind it, if it is one."""
        known = self._read.get((kind, str(source)))
        if known is None:
            found = self._opened(kind, source)
            known = (found, None) if isinstance(found, str) else (found.sha256(), File(kind, found))
            self._read[kind, str(source)] = known
        return known

    def _opened(self, kind: Kind, source: str | Path) -> Upload | str:
        if kind == "object":
            return object_upload(source) if isinstance(source, Path) else source
        is_file = Path(source).suffix.lower() in (CLASSIFIER_SUFFIXES if kind == "classifier" else PICTURE_SUFFIXES)
        path = self.path(str(source)) if is_file else str(source)
        return classifier_source(path) if kind == "classifier" else background_source(path)
