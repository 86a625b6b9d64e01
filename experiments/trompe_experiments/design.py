"""File of an experiment: objects, options, and the number of seeds.

    name: quick                       # its jobs get the label experiment=quick
    base: {classifier: tiny, steps: 20}       # options of every job; `preset: fast` sets those of a preset
    objects: shipped                  # or {assets: $TROMPE_ASSETS}, or a table of objects
    grid: {epsilon: [0.02, 0.05], tau: [null, 0.05]}      # all combinations; each grid of a list is one series
    cases: {dark: {ranges: {intensity: [0.2, 0.2]}}}      # named variations, each combined with the grid
    seeds: [0, 1, 2]
    judgement: {views: 60, seed: 1}     # judges the painted objects, the unpainted one and noise on the same views

Options are keywords of the SDK (``trompe_shared.api.OPTIONS``). Later ones override earlier ones: base, object, grid,
case.
"""

import os
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from trompe_shared.api import ADVERSARIAL, OPTIONS, JudgementRequest
from trompe_shared.errors import SpecError
from trompe_shared.faults import Fault, faults_of
from trompe_shared.presets import with_preset

ELSEWHERE: Final = {"object": "list objects under `objects`", "seed": "list seeds under `seeds`"}
"""Options of a job that a file sets in another place."""
ALLOWED: Final = [*(name for name in OPTIONS if name not in ELSEWHERE), "priority", "needs"]
OF_JOBS: Final = dict.fromkeys(
    ("before", "after", "label", "networks", "epsilon", "distance", "elevation", "background", "priority"),
    "the experiment sets it for each object",
)
"""Options of a judgement that a file cannot set, and why."""
JUDGED: Final = [name for name in JudgementRequest.model_fields if name not in OF_JOBS]
FRACTION: Final = re.compile(r"^(\d+(?:\.\d+)?)/(\d+)$")

MOST_SEEDS: Final = 1000

Options = dict[str, Any]


def _known(options: Options, *, allowed: Sequence[str] = ALLOWED, elsewhere: Mapping[str, str] = ELSEWHERE) -> Options:
    """Options with fractions such as 4/255 as numbers. Raises ``ValueError`` for an unknown one."""
    for name in options:
        if name in allowed:
            continue
        if name in elsewhere:
            raise ValueError(f"{name!r} is not an option here: {elsewhere[name]}")
        close = get_close_matches(str(name), allowed, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"unknown option {name!r}; {hint}Options: {', '.join(allowed)}")
    return {name: _number(value) for name, value in options.items()}


def _number(value: Any) -> Any:
    if isinstance(value, list):
        return [_number(each) for each in value]
    found = FRACTION.match(value) if isinstance(value, str) else None
    if found and not float(found[2]):
        raise ValueError(f"{value!r} divides by zero; give a fraction such as 4/255, or a number")
    return float(found[1]) / float(found[2]) if found else value


def _base(options: Options) -> Options:
    return _known(with_preset(options))


def _case(options: Options) -> Options:
    """A case may have seeds of its own."""
    seeds = _seeds(options.get("seeds", [0]))
    if not isinstance(seeds, list) or not seeds or not all(isinstance(seed, int) for seed in seeds):
        raise ValueError(f"'seeds' must be a list of integers or their number; got {options['seeds']!r}")
    others = _base({name: value for name, value in options.items() if name != "seeds"})
    return others | ({"seeds": seeds} if "seeds" in options else {})


def _object(options: Options) -> Options:
    return _known(options, allowed=[*ALLOWED, "file"])


def _grids(given: Any) -> Any:
    return [given] if isinstance(given, dict) else given


def _grid(options: Options) -> Options:
    known = _known({name: values for name, values in options.items() if name != "preset"})
    for name, values in options.items():
        if not isinstance(values, list) or not values:
            raise ValueError(f"{name!r} must be a list of values; got {values!r}")
        if any(value in values[:number] for number, value in enumerate(values)):
            raise ValueError(f"{name!r} gives a value twice: {values!r}")
    for preset in options.get("preset", []):
        with_preset({"preset": preset})
    return known | {name: options[name] for name in options if name == "preset"}


def _judgement(options: Options) -> Options:
    """Checked as those of a judgement of any two objects by one network in one renderer."""
    known = _known(options, allowed=JUDGED, elsewhere=OF_JOBS)
    try:
        asked = JudgementRequest.of("mug", "mug", label="mug", **known)
    except SpecError as error:
        raise ValueError(str(error)) from error
    if asked.suite is not None or len(asked.renderers) > 1:
        raise ValueError(
            "a judgement here has one network and one renderer: leave out `suite`, name one of `renderers`"
        )
    return known


def _seeds(given: Any) -> Any:
    if not isinstance(given, int) or isinstance(given, bool):
        return given
    if given > MOST_SEEDS:
        raise ValueError(f"{given} is the number of seeds, at most {MOST_SEEDS}; for this one seed write [{given}]")
    return list(range(given))


def _objects(given: Any) -> Any:
    """An object of a table may be without options."""
    if given != "shipped" and not isinstance(given, Mapping | AssetsFolder):
        raise ValueError("expected shipped, {assets: FOLDER}, or a table of objects such as {mug: {}, chair: {}}")
    if not isinstance(given, Mapping) or "assets" in given:
        return given
    return {name: {} if options is None else options for name, options in given.items()}


def _distinct(seeds: list[int]) -> list[int]:
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"{seeds} gives a seed twice, which is one job and counts once")
    return seeds


class _Schema(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class AssetsFolder(_Schema):
    """Objects of a folder with ``objects/objects.json``, which gives distance, elevations, class and background.

    ``only``: names of the objects to use.
    """

    assets: str
    only: list[str] = Field(default_factory=list)


class Experiment(_Schema):
    """A checked file. Relative paths start at ``folder``."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,62}$")]
    description: str = ""
    base: Annotated[Options, AfterValidator(_base)] = Field(default_factory=dict)
    objects: Annotated[
        Literal["shipped"]
        | AssetsFolder
        | Annotated[dict[str, Annotated[Options, AfterValidator(_object)]], Field(min_length=1)],
        BeforeValidator(_objects),
    ]
    grid: Annotated[list[Annotated[Options, AfterValidator(_grid)]], BeforeValidator(_grids), Field(min_length=1)] = (
        Field(default=[{}])
    )
    cases: dict[str, Annotated[Options, AfterValidator(_case)]] = Field(default_factory=dict)
    seeds: Annotated[list[int], BeforeValidator(_seeds), AfterValidator(_distinct), Field(min_length=1)] = Field(
        default_factory=lambda: [0]
    )
    judgement: Annotated[Options, AfterValidator(_judgement)] | None = Field(
        default=None, description="judge the painted objects, the unpainted one and noise, with these options"
    )
    artifacts: list[str] = Field(default_factory=list, description="files of each job to keep; * and ? match")
    folder: Path = Path()

    @property
    def kept(self) -> list[str]:
        """Patterns of the files to keep: ``artifacts``, and with a judgement the painted objects."""
        return self.artifacts + ([f"*{ADVERSARIAL}.zip"] if self.judgement is not None else [])


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which PyYAML takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for number, key in enumerate(keys):
            if key.value in {each.value for each in keys[:number]}:
                raise yaml.MarkedYAMLError(problem=f"{key.value!r} is given twice", problem_mark=key.start_mark)
        return super().construct_mapping(node, deep)


def shipped_experiments() -> dict[str, Path]:
    """The shipped files by name."""
    return {file.stem: file for file in sorted(Path(__file__).parent.glob("files/*.yaml"))}


def experiment_file(source: str | Path) -> Path:
    """The shipped file of that name, otherwise ``source`` itself."""
    return shipped_experiments().get(str(source), Path(source))


def load_experiment(source: str | Path) -> Experiment:
    """Read and check a file, or a shipped one by its name. Raises ``SpecError``."""
    path = experiment_file(source)
    try:
        read = yaml.load(path.read_text("utf-8"), _Loader)
    except FileNotFoundError as error:
        raise SpecError(
            f"No experiment {str(source)!r}. Give a file, or one of {', '.join(shipped_experiments())}."
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SpecError(f"{str(path)!r} is not YAML: {error}") from error
    if not isinstance(read, Mapping):
        raise SpecError(
            f"{str(path)!r} must be a table with name, objects and grid, such as "
            "{name: mine, objects: {mug: {}}, grid: {epsilon: [0.02, 0.05]}}."
        )
    try:
        return Experiment.model_validate({**read, "folder": path.parent.absolute()})
    except ValidationError as error:
        raise SpecError(f"{str(path)!r}: " + "; ".join(map(_told, faults_of(error)))) from error


def expanded(text: str) -> str:
    """``text`` with environment variables replaced. Raises ``SpecError`` for an unset one."""
    missing = [name for name in re.findall(r"\$\{?(\w+)", text) if not os.environ.get(name)]
    if missing:
        raise SpecError(f"{text!r} needs the environment variable {missing[0]}; set it to a folder.")
    return os.path.expandvars(text)


def _told(fault: Fault) -> str:
    if fault.kind == "extra_forbidden":
        known = [name for name in Experiment.model_fields if name != "folder"]
        return f"unknown key {fault.place!r}; keys: {', '.join(known)}"
    return str(fault)
