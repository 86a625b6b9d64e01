"""The file of an experiment: what is varied, over which objects, and with how many seeds.

    name: quick                       # its jobs carry the label experiment=quick
    base: {classifier: tiny, steps: 20}       # fields of every job; ``preset: fast`` stands for a preset's
    objects: shipped                  # or {assets: $TROMPE_ASSETS}, or a table of objects
    grid: {epsilon: [0.02, 0.05], tau: [null, 0.05]}      # every combination; a list of grids is one series each
    cases: {dark: {ranges: {intensity: [0.2, 0.2]}}}      # named variations, of which each is combined with the grid
    seeds: [0, 1, 2]

Fields are those of a job (``trompe attack --help``, ``JobSpec``). A later one wins: base, object, grid, case.
"""

import os
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from trompe_shared.api import JobRequest
from trompe_shared.errors import SpecError
from trompe_shared.faults import Fault, faults_of
from trompe_shared.presets import PRESETS

__all__ = ["AssetsFolder", "Experiment", "expanded", "experiment_file", "load_experiment", "shipped_experiments"]

OWN: Final = {"object": "list the objects under `objects`", "seed": "list the seeds under `seeds`"}
"""Fields of a job that a file sets in another place."""
FIELDS: Final = [name for name in JobRequest.model_fields if name not in {*OWN, "labels"}]
FRACTION: Final = re.compile(r"^(\d+(?:\.\d+)?)/(\d+)$")

Fields = dict[str, Any]


def _known(fields: Fields, *, also: Sequence[str] = ()) -> Fields:
    """``fields`` of a job, with fractions such as 4/255 as numbers. Raises ``ValueError`` for an unknown one."""
    allowed = [*FIELDS, *also]
    for name in fields:
        if name in allowed:
            continue
        if name in OWN:
            raise ValueError(f"{name!r} is not set here: {OWN[name]}")
        close = get_close_matches(str(name), allowed, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"there is no field {name!r}; {hint}There are: {', '.join(allowed)}")
    return {name: _number(value) for name, value in fields.items()}


def _number(value: Any) -> Any:
    if isinstance(value, list):
        return [_number(each) for each in value]
    found = FRACTION.match(value) if isinstance(value, str) else None
    return float(found[1]) / float(found[2]) if found else value


def _base(fields: Fields) -> Fields:
    """``preset`` stands for its options, those that the file gives win."""
    preset = fields.pop("preset", None)
    if preset is not None and preset not in PRESETS:
        raise ValueError(f"there is no preset {preset!r}; there are {', '.join(PRESETS)}")
    return _known((dict(PRESETS[preset].options) if preset else {}) | fields)


def _case(fields: Fields) -> Fields:
    """A variation may have seeds of its own."""
    seeds = _seeds(fields.get("seeds", [0]))
    if not isinstance(seeds, list) or not seeds or not all(isinstance(seed, int) for seed in seeds):
        raise ValueError(f"'seeds' must be a list of whole numbers or how many there are, got {fields['seeds']!r}")
    others = _base({name: value for name, value in fields.items() if name != "seeds"})
    return others | ({"seeds": seeds} if "seeds" in fields else {})


def _object(fields: Fields) -> Fields:
    return _known(fields, also=["file"])


def _grids(given: Any) -> Any:
    return [given] if isinstance(given, dict) else given


def _grid(fields: Fields) -> Fields:
    known = _known({name: values for name, values in fields.items() if name != "preset"})
    for name, values in fields.items():
        if not isinstance(values, list) or not values:
            raise ValueError(f"{name!r} must be a list of the values to try, got {values!r}")
    return known | {name: fields[name] for name in fields if name == "preset"}


def _seeds(given: Any) -> Any:
    return list(range(given)) if isinstance(given, int) and not isinstance(given, bool) else given


class _Schema(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class AssetsFolder(_Schema):
    """Objects from a folder with an ``objects/objects.json``, with the distance, elevations, class and background that
    it gives. ``only`` some of them."""

    assets: str
    only: list[str] = Field(default_factory=list)


class Experiment(_Schema):
    """A file that was read and checked. ``folder`` is where its relative paths begin."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,62}$")]
    description: str = ""
    base: Annotated[Fields, AfterValidator(_base)] = Field(default_factory=dict)
    objects: (
        Literal["shipped"]
        | AssetsFolder
        | Annotated[dict[str, Annotated[Fields, AfterValidator(_object)]], Field(min_length=1)]
    )
    grid: Annotated[list[Annotated[Fields, AfterValidator(_grid)]], BeforeValidator(_grids), Field(min_length=1)] = (
        Field(default=[{}])
    )
    cases: dict[str, Annotated[Fields, AfterValidator(_case)]] = Field(default_factory=dict)
    seeds: Annotated[list[int], BeforeValidator(_seeds), Field(min_length=1)] = Field(default_factory=lambda: [0])
    artifacts: list[str] = Field(default_factory=list, description="files of each job to keep, such as a contact sheet")
    folder: Path = Path()


def shipped_experiments() -> dict[str, Path]:
    """The files that come with Trompe, by name."""
    folder = Path(str(resources.files("trompe_client.experiments"))) / "files"
    return {file.stem: file for file in sorted(folder.glob("*.yaml"))}


def experiment_file(source: str | Path) -> Path:
    """The file of an experiment: one that comes with Trompe, by its name, or ``source`` itself."""
    return shipped_experiments().get(str(source), Path(source))


def load_experiment(source: str | Path) -> Experiment:
    """Read and check a file, or one that comes with Trompe by its name. Raises ``SpecError``."""
    path = experiment_file(source)
    try:
        read = yaml.safe_load(path.read_text("utf-8"))
    except FileNotFoundError as error:
        raise SpecError(
            f"There is no experiment {str(source)!r}. Give a file, or one of {', '.join(shipped_experiments())}."
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SpecError(f"{str(path)!r} is not YAML: {error}") from error
    if not isinstance(read, Mapping):
        raise SpecError(f"{str(path)!r} must be a table with name, objects and grid, as in `trompe experiment --help`.")
    try:
        return Experiment.model_validate({**read, "folder": path.parent.absolute()})
    except ValidationError as error:
        raise SpecError(f"{str(path)!r}: " + "; ".join(map(_told, faults_of(error)))) from error


def expanded(text: str) -> str:
    """``text`` with $NAME replaced from the environment. Raises ``SpecError`` for a name that is not set."""
    missing = [name for name in re.findall(r"\$\{?(\w+)", text) if not os.environ.get(name)]
    if missing:
        raise SpecError(f"{text!r} needs the environment variable {missing[0]}; set it to the folder that is meant.")
    return os.path.expandvars(text)


def _told(fault: Fault) -> str:
    if fault.kind == "extra_forbidden":
        known = [name for name in Experiment.model_fields if name != "folder"]
        return f"there is no {fault.place!r}; there are {', '.join(known)}"
    return str(fault)
