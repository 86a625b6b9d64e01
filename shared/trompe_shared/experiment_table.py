"""The table of an experiment: one row per job, with the same columns wherever the job ran.

``results.csv`` holds ``ResultRow``s, ``predictions.csv`` ``PredictionRow``s. Every figure is made from these two files.
"""

import csv
import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from trompe_shared.api import Accuracy, JobSpec, Result
from trompe_shared.errors import SpecError

__all__ = [
    "PREDICTIONS",
    "RESULTS",
    "PredictionRow",
    "ResultRow",
    "RowId",
    "job_key",
    "prediction_rows",
    "read_table",
    "write_table",
]

RESULTS, PREDICTIONS = "results.csv", "predictions.csv"
"""File names in the folder of an experiment."""

SEPARATOR = " | "
"""Between several warnings, networks or backgrounds in one cell."""


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RowId(_Row):
    """Where a row belongs.

    ``key`` is the same for the same job of the same experiment. ``series`` names the grid it comes from, ``case`` its
    named variation, ``configuration`` all that varies in it but object and seed.
    """

    experiment: str
    key: str
    series: str = ""
    case: str = ""
    configuration: str = ""


KEY_VERSION: Final = 1
"""To be raised by hand when a default, or what an option does, changes: what was measured before counts no more."""


def job_key(experiment: str, spec: JobSpec, *more: str) -> str:
    """The key of a job of an experiment, and of what ``more`` tells it apart by.

    Only what differs from the defaults counts. An option that a later version adds changes no key as long as nobody
    asks for it, and so the folder of an experiment goes on under that version; see ``KEY_VERSION``.
    """
    asked = spec.model_dump(mode="json", exclude_defaults=True)
    text = json.dumps([KEY_VERSION, asked, *more], sort_keys=True)
    return f"{experiment}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"


class ResultRow(RowId):
    """One job: what was asked, what came out, what it cost. A cell is empty (``None``) where there is nothing to say.

    Shares and colour differences as in ``Result``; ``_low`` and ``_high`` are the ends of 95 % intervals; ``_s`` are
    seconds. ``surrogate`` and ``steps`` are what was asked for; ``surrogate_model``, ``steps_taken`` what came of it.
    Files of earlier versions may lack columns; the fields of these are then unset.
    """

    job: str = ""
    state: str
    object: str
    label: str
    classifier: str
    ensemble: str = ""
    diverse: bool | None = None
    attack_on: str = ""
    epsilon: float
    alpha: float
    tau: float | None = None
    keep: float | None = None
    loss: str
    optimiser: str
    surrogate: str
    steps: int
    restarts: int
    seed: int
    pool: int
    views_per_step: int | None = None
    background: str
    device: str = "cpu"
    threads: int | None = None
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
    probe_renders: int | None = None
    prepare_s: float | None = None
    calibrate_s: float | None = None
    attack_s: float | None = None
    judge_s: float | None = None
    seconds: float | None = None
    warnings: str = ""
    error: str = ""

    @classmethod
    def of_spec(cls, place: RowId, spec: JobSpec, *, state: str, **more: Any) -> Self:
        """A job of which only the options are known; ``more`` are further columns."""
        asked = {name: getattr(spec, name) for name in _ASKED}
        named = {
            "label": str(spec.label),
            "ensemble": SEPARATOR.join(spec.ensemble),
            "background": SEPARATOR.join(spec.background),
            "views_per_step": spec.n_views_per_step,
        }
        return cls.model_validate(place.model_dump() | asked | named | {"state": state} | more)

    @classmethod
    def of_result(cls, place: RowId, result: Result, *, state: str, **more: Any) -> Self:
        """A job that came to a result; ``more`` are further columns."""
        height, width = result.image_size
        found = {
            "object": result.object,
            "label": result.label_name or str(result.label),
            "classifier": result.classifier,
            "ensemble": SEPARATOR.join(result.ensemble),
            "image_size": f"{width}x{height}",
            "steps_taken": result.steps if result.surrogate is not None else None,
            **{name: getattr(result, name) for name in _FOUND},
            **_accuracy("surrogate", result.surrogate, interval=False),
            **_accuracy("target", result.target),
            **_accuracy("held_out", result.held_out),
            "views": result.target.views,
            "held_out_views": result.held_out.views if result.held_out else 0,
            **{f"fidelity_{name}": value for name, value in result.fidelity.items()},
            **_seconds(result),
            "warnings": SEPARATOR.join(result.warnings),
        }
        return cls.of_spec(place, result.spec, state=state, **(found | more))


_ASKED = (
    *("object", "classifier", "diverse", "attack_on", "epsilon", "alpha", "tau", "keep", "loss", "optimiser"),
    *("surrogate", "steps", "restarts", "seed", "pool"),
)
_FOUND = (
    *("surrogate_model", "transfer_gap", "texels_altered", "mean_texel_change", "max_view_change"),
    *("views_beyond_epsilon", "ssim", "delta_e", "evaluations", "probe_renders"),
)


def _accuracy(views: str, found: Accuracy | None, *, interval: bool = True) -> dict[str, float | None]:
    if found is None:
        return {}
    shares = {f"{views}_{name}": getattr(found, name) for name in ("a_before", "a_after", "a_drop")}
    low, high = found.a_drop_interval or (None, None)
    return shares | ({f"{views}_a_drop_low": low, f"{views}_a_drop_high": high} if interval else {})


def _seconds(result: Result) -> dict[str, float]:
    """Seconds by kind of phase (attack-000, attack-001, ... are one kind), and of all."""
    by_kind: Counter[str] = Counter()
    for phase, seconds in result.seconds.items():
        by_kind[f"{phase.partition('-')[0]}_s"] += seconds  # type: ignore[assignment]
    known = {name: round(seconds, 3) for name, seconds in by_kind.items() if name in ResultRow.model_fields}
    return known | {"seconds": round(sum(result.seconds.values()), 3)}


class PredictionRow(_Row):
    """How many of a job's views were taken for a class.

    ``views`` is target or held_out; ``moment`` before or after; ``name`` the class's, where it is known.
    """

    key: str
    views: str
    moment: str
    class_index: int
    name: str
    true_class: bool
    count: int


def prediction_rows(key: str, result: Result, classes: Sequence[str] | None) -> list[PredictionRow]:
    """The predictions of one job, the most frequent class first; ``classes`` are names by index, where known."""
    rows = []
    for views, predictions in (("target", result.views), ("held_out", result.held_out_views)):
        for moment in ("before", "after"):
            said = [getattr(view, moment) for view in predictions]
            for index, count in Counter(each for each in said if each is not None).most_common():
                rows.append(
                    PredictionRow(
                        key=key,
                        views=views,
                        moment=moment,
                        class_index=index,
                        name=classes[index] if classes else f"class {index}",
                        true_class=index == result.label,
                        count=count,
                    )
                )
    return rows


R = TypeVar("R", bound=_Row)


def write_table(path: Path, rows: Iterable[ResultRow] | Iterable[PredictionRow], kind: type[_Row] = ResultRow) -> None:
    """Write rows of one kind as CSV, whole or not at all."""
    partial = path.with_name(f".{path.name}.part")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(kind.model_fields), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.model_dump().items()} for row in rows)
    partial.replace(path)


def _cell(value: object) -> object:
    """Numbers with six digits: more are noise, and would change from machine to machine."""
    return f"{value:.6g}" if isinstance(value, float) else value


def read_table(path: Path, kind: type[R]) -> list[R]:
    """The rows of a CSV file. Raises ``SpecError`` for a file that is not one of ``kind``."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [kind.model_validate(_filled(row, kind)) for row in csv.DictReader(file)]
    except FileNotFoundError as error:
        raise SpecError(f"There is no table {str(path)!r}. `trompe experiment run` writes it.") from error
    except (ValidationError, csv.Error, UnicodeDecodeError) as error:
        told = str(error).splitlines()[:3]
        raise SpecError(f"{str(path)!r} is not a table of this kind and version ({' '.join(told)}).") from error


def _filled(row: dict[str, str], kind: type[_Row]) -> dict[str, str | None]:
    """Cells as pydantic takes them: an empty one is ``None``, but for columns of text."""
    return {name: cell if cell or kind.model_fields[name].annotation is str else None for name, cell in row.items()}
