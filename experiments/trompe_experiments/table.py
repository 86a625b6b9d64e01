"""Tables of an experiment: ``results.csv`` (``ResultRow``) and ``predictions.csv`` (``PredictionRow``).

All figures are made from these two files.
"""

import csv
import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from trompe_experiments.markdown import NOT_APPLICABLE, figure_words
from trompe_shared.api import OPTIONS, Accuracy, JobSpec, JobState, Option, Result
from trompe_shared.errors import SpecError
from trompe_shared.faults import faults_of

RESULTS, PREDICTIONS = "results.csv", "predictions.csv"
"""File names in the folder of an experiment."""
REFUSED: Final = "refused"
"""State of a row whose job the server refused."""
TO_RETRY: Final = {JobState.failed.value, JobState.cancelled.value, REFUSED}

MOST_FAULTS: Final = 3
"""Faults of a row that are told."""

SEPARATOR = " | "
"""Between several warnings, networks or backgrounds in one cell."""


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RowId(_Row):
    """Identity of a row.

    ``key`` is equal for equal jobs of an experiment. ``series`` names the row's grid, ``case`` its named variation,
    ``configuration`` everything that varies in the grid except object and seed.
    """

    experiment: str
    key: str
    series: str = ""
    case: str = ""
    configuration: str = ""


KEY_VERSION: Final = 3
"""Raise it when a default or the effect of an option changes: earlier results then no longer count."""


def job_key(experiment: str, spec: JobSpec, *more: str) -> str:
    """Key of a job of an experiment; ``more`` distinguishes jobs with the same options.

    It depends only on options that differ from their defaults, so a new option keeps the keys of existing jobs and an
    experiment's folder stays valid under a later version; see ``KEY_VERSION``. An image pipeline counts by its name,
    chosen or not: random views had none in 0.1.
    """
    asked = spec.model_dump(mode="json", exclude_defaults=True)
    pipeline = () if spec.image_pipeline == "none" else (spec.image_pipeline,)
    text = json.dumps([KEY_VERSION, asked, *more, *pipeline], sort_keys=True)
    return f"{experiment}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"


def _column(option: Option) -> Any:
    """Type and default of an option's column: its own type if that is a number or a flag, otherwise text."""
    return (option.type | None, None) if option.type in {int, float, bool} else (str, "")


_Options: Any = create_model("_Options", __base__=RowId, **{name: _column(each) for name, each in OPTIONS.items()})


class ResultRow(_Options):  # type: ignore[misc]
    """One job: options (a column for each of ``OPTIONS``), outcome and cost. A cell without a value is ``None``.

    Shares and colour differences as in ``Result``; ``_low`` and ``_high`` are ends of 95 % intervals; ``_s`` are
    seconds. ``surrogate`` and ``steps`` are the options; ``surrogate_model`` and ``steps_taken`` the outcome.
    Columns that a file lacks are unset.
    """

    job: str = ""
    state: str
    object: str
    image_size: str = ""
    surrogate_model: str = ""
    steps_taken: int | None = None
    views: int | None = None
    held_out_views: int | None = None
    surrogate_a_before: float | None = None
    surrogate_a_after: float | None = None
    surrogate_a_drop: float | None = None
    target_a_before: float | None = None
    target_a_after: float | None = None
    target_a_drop: float | None = None
    target_a_drop_low: float | None = None
    target_a_drop_high: float | None = None
    held_out_a_before: float | None = None
    held_out_a_after: float | None = None
    held_out_a_drop: float | None = None
    held_out_a_drop_low: float | None = None
    held_out_a_drop_high: float | None = None
    transfer_gap: float | None = None
    disagreement: float | None = None
    margin_error: float | None = None
    texels_altered: float | None = None
    mean_texel_change: float | None = None
    max_view_change: float | None = None
    views_beyond_epsilon: float | None = None
    ssim: float | None = None
    delta_e: float | None = None
    fidelity_correlation: float | None = None
    fidelity_slope: float | None = None
    fidelity_error: float | None = None
    fidelity_explained: float | None = None
    evaluations: int | None = None
    attacked_views: int | None = None
    probe_renders: int | None = None
    further_renders: int | None = None
    prepare_s: float | None = None
    calibrate_s: float | None = None
    attack_s: float | None = None
    judge_s: float | None = None
    seconds: float | None = None
    judge_drops: str = ""
    renderer_drops: str = ""
    pipeline_drops: str = ""
    warnings: str = ""
    error: str = ""

    @property
    def drops_through(self) -> dict[str, float | None]:
        """Held-out ``A_drop`` through each image pipeline of the judges, by its name; ``None`` where it is n.a."""
        words = [each.rpartition(" ") for each in self.pipeline_drops.split(SEPARATOR) if each]
        return {name: None if drop == NOT_APPLICABLE else float(drop) for name, _, drop in words}

    @property
    def dissimilarity(self) -> float | None:
        """1 - SSIM."""
        return None if self.ssim is None else 1 - self.ssim

    @classmethod
    def of_spec(cls, place: RowId, spec: JobSpec, *, state: str, **more: Any) -> Self:
        """A job without a result; ``more`` are further columns."""
        resolved = {"alpha": spec.alpha, "image_pipeline": spec.image_pipeline, "views_per_step": spec.views_per_step}
        values = (spec.options() | resolved).items()
        asked = {name: _text(value) if cls.model_fields[name].annotation is str else value for name, value in values}
        row: Self = cls.model_validate(place.model_dump() | {"object": spec.object, "state": state} | asked | more)
        return row

    @classmethod
    def of_result(cls, place: RowId, result: Result, *, state: str, **more: Any) -> Self:
        """A job with a result; ``more`` are further columns."""
        height, width = result.image_size
        found = {
            "object": result.object,
            "label": SEPARATOR.join(result.label_names or map(str, result.labels)),
            "classifier": result.classifier,
            "ensemble": SEPARATOR.join(result.ensemble),
            "image_size": f"{width}x{height}",
            "steps_taken": result.steps if result.surrogate is not None else None,
            **{name: getattr(result, name) for name in cls.model_fields if name in _FOUND},
            **_accuracy("surrogate", result.surrogate, interval=False),
            **_accuracy("target", result.target),
            **_accuracy("held_out", result.held_out),
            "views": result.target.views,
            "held_out_views": result.held_out.views if result.held_out else 0,
            **{f"fidelity_{name}": value for name, value in result.fidelity.items()},
            **_seconds(result),
            "judge_drops": SEPARATOR.join(_drop_words(it.classifier, it.held_out or it.target) for it in result.judges),
            "renderer_drops": SEPARATOR.join(
                _drop_words(it.renderer.name, it.held_out or it.target) for it in result.renderers
            ),
            "pipeline_drops": SEPARATOR.join(_drop_words(it.pipeline, it.held_out) for it in result.image_pipelines),
            "warnings": SEPARATOR.join(result.warnings),
        }
        return cls.of_spec(place, result.spec, state=state, **(found | more))

    @property
    def failed(self) -> bool:
        """Whether the expected result is missing; n.a. is a result."""
        return self.state in TO_RETRY

    @property
    def judged_drop(self) -> float | None:
        """``A_drop`` on held-out views; on the attacked ones if there are none."""
        return self.target_a_drop if self.held_out_views == 0 else self.held_out_a_drop


_FOUND: Final = set(Result.model_fields) - {
    *OPTIONS,
    "object",
    "views",
    "held_out_views",
    "image_size",
    "seconds",
    "warnings",
}
"""Figures of a result that are columns under the same name."""


def _text(value: Any) -> str:
    """An option's value as text: lists joined, tables as JSON, defaults of tables left out."""
    if isinstance(value, list | tuple):
        return SEPARATOR.join(map(str, value))
    fields = value.model_dump(exclude_defaults=True) if isinstance(value, BaseModel) else value
    if fields is None or fields == {}:
        return ""
    return json.dumps(fields) if isinstance(fields, dict) else str(fields)


def _accuracy(views: str, found: Accuracy | None, *, interval: bool = True) -> dict[str, float | None]:
    if found is None:
        return {}
    shares = {f"{views}_{name}": getattr(found, name) for name in ("a_before", "a_after", "a_drop")}
    low, high = found.a_drop_interval or (None, None)
    return shares | ({f"{views}_a_drop_low": low, f"{views}_a_drop_high": high} if interval else {})


def _drop_words(name: str, judged: Accuracy) -> str:
    return f"{name} {figure_words(judged.a_drop, '.3f')}"


def _seconds(result: Result) -> dict[str, float]:
    """Seconds by kind of phase (attack-000, attack-001, ... are one kind), and their sum."""
    by_kind: Counter[str] = Counter()
    for phase, seconds in result.seconds.items():
        by_kind[f"{phase.partition('-')[0]}_s"] += seconds  # type: ignore[assignment]
    known = {name: round(seconds, 3) for name, seconds in by_kind.items() if name in ResultRow.model_fields}
    return known | {"seconds": round(sum(result.seconds.values()), 3)}


class PredictionRow(_Row):
    """Number of a job's views with one predicted class.

    ``views`` is target or held_out; ``moment`` before or after; ``name`` the class's, if known.
    """

    key: str
    views: str
    moment: str
    class_index: int
    name: str
    true_class: bool
    count: int


def prediction_rows(key: str, result: Result, classes: Sequence[str] | None) -> list[PredictionRow]:
    """The predictions of one job, the most frequent class first; ``classes`` are names by index, if known."""
    rows = []
    for views, predictions in (("target", result.views), ("held_out", result.held_out_views)):
        for moment in ("before", "after"):
            said = [getattr(view, moment) for view in predictions]
            for index, count in Counter(each for each in said if each is not None).most_common():
                name = classes[index] if classes else f"class {index}"
                place = {"key": key, "views": views, "moment": moment, "class_index": index, "name": name}
                rows.append(PredictionRow(**place, true_class=index in result.labels, count=count))
    return rows


R = TypeVar("R", bound=BaseModel)


def write_table(path: Path, rows: Iterable[RowId] | Iterable[PredictionRow], kind: type[BaseModel] = ResultRow) -> None:
    """Write rows of one kind as CSV, atomically."""
    partial = path.with_name(f".{path.name}.part")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(kind.model_fields), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.model_dump().items()} for row in rows)
    partial.replace(path)


def _cell(value: object) -> object:
    """Numbers with six digits: further digits are noise that differs between machines."""
    return f"{value:.6g}" if isinstance(value, float) else value


def read_table(path: Path, kind: type[R], *, optional: bool = False) -> list[R]:
    """The rows of a CSV file; none for a missing ``optional`` one. Raises ``SpecError``."""
    rows: list[R] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets write a byte order mark
            rows.extend(kind.model_validate(_filled(row, kind)) for row in csv.DictReader(file))
    except FileNotFoundError as error:
        if optional:
            return []
        raise SpecError(f"No table {str(path)!r}; `trompe experiment run` writes it.") from error
    except (ValidationError, csv.Error, UnicodeDecodeError) as error:
        faults = [*map(str, faults_of(error))] if isinstance(error, ValidationError) else [str(error)]
        more = f"; and {len(faults) - MOST_FAULTS} more" if len(faults) > MOST_FAULTS else ""
        raise SpecError(
            f"{str(path)!r}, row {len(rows) + 1}, does not fit this version: {'; '.join(faults[:MOST_FAULTS])}{more}. "
            "Expected UTF-8 with commas, columns as `trompe experiment run` writes them: mend the file, or move it."
        ) from error
    return rows


def read_results(folder: str | Path) -> list[ResultRow]:
    """The rows of an experiment's folder, or of a CSV file. Raises ``SpecError``, also if there are none."""
    path = Path(folder)
    table = path / RESULTS if path.is_dir() else path
    rows = read_table(table, ResultRow)
    if not rows:
        raise SpecError(f"{str(table)!r} has no rows yet; `trompe experiment run` writes them as jobs end.")
    return rows


def _filled(row: Mapping[str, str], kind: type[BaseModel]) -> dict[str, str | None]:
    """Cells for pydantic: an empty one is ``None``, except in columns of text."""
    texts = {name for name, field in kind.model_fields.items() if field.annotation is str}
    return {name: cell if cell or name in texts else None for name, cell in row.items()}
