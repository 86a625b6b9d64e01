"""Options of a job, in parts. Each option is declared here once: type, default, range, help and spelling.

CLI flags, the SDK's keywords, the page's form, the printed command and the columns of results are made from
``OPTIONS``, the flat list of all fields of all parts. Errors, notes and warnings name an option by its keyword in
backquotes, with or without a value: `epsilon`, `queries: 10`. The command line prints its flags instead (``in_flags``).
"""

import math
import re
from collections.abc import Mapping
from difflib import get_close_matches
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Self, SupportsIndex, TypedDict, Union, Unpack, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from trompe_shared.errors import SpecError

SurrogateModel = Literal["auto", "diffuse", "calibrated", "curve"]
OptimiserName = Literal["pgd", "nesterov"]
Loss = Literal["margin", "cross_entropy"]
PipelineName = Literal["none", "robust", "transfer"]
Conditions = Literal["usual", "wide"]
Priority = Literal["interactive", "normal", "sweep"]
Labels = Annotated[
    dict[
        Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,62}$")],
        Annotated[str, Field(min_length=1, max_length=200)],
    ],
    Field(max_length=32, description="labels of your own, to find jobs by"),
]


def _no_truth(given: Any) -> Any:
    if isinstance(given, bool):
        raise ValueError(f"should not be a truth value; got {str(given).lower()}")
    return given


Number = Annotated[float, BeforeValidator(_no_truth)]
Range = tuple[Number, Number]
Channel = Annotated[int, Field(ge=0, le=255), BeforeValidator(_no_truth)]
Colour = tuple[Channel, Channel, Channel]

PAPER_AZIMUTHS: Final = 6
"""Azimuths of the paper's grid, 0 to 360 degrees with both ends: five distinct ones."""

MOST_VIEWS: Final = 2000
"""Largest pool."""

VIEWS_PER_STEP: Final = 40
"""Default number of a pool's views in one step."""


class Schema(BaseModel):
    """Base of all models of the contract: it refuses unknown fields."""

    model_config = ConfigDict(extra="forbid")


class _Part(Schema):
    model_config = ConfigDict(frozen=True)

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_as_number(cls, given: Any, info: ValidationInfo) -> Any:
        assert info.field_name is not None
        return given if cls.model_fields[info.field_name].annotation is bool else _no_truth(given)


Amount = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]


class Needs(_Part):
    """What an attempt of a job occupies while it runs."""

    cpu: Amount = Field(default=1.0, description="cores; several small jobs may share one")
    gpu: Amount = Field(default=0.0, description="CUDA devices; 0.5: two such jobs share one")
    memory: Amount = Field(default=0.0, description="GiB")

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:g}" for name, value in self if value) or "nothing"


class ViewRanges(_Part):
    """Ranges (low, high) of random views, each quantity uniform in its range; angles in degrees."""

    azimuth: Range = (0.0, 360.0)
    distance_factor: Range = Field(default=(0.9, 1.1), description="factor of the job's distance")
    roll: Range = (0.0, 0.0)
    light_azimuth: Range = (-70.0, 70.0)
    light_elevation: Range = (35.0, 88.0)
    intensity: Range = Field(default=(1.25, 1.25), description="1 lights a white surface that faces the light white")
    ambient: Range = Field(default=(0.5, 0.5), description="share of white that reaches every surface")
    light_colours: tuple[Colour, Colour] = Field(
        default=((255, 255, 255), (255, 255, 255)),
        description="ends of the line, in linear light, from which the light's colour is drawn",
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        for name, (least, most) in VIEW_LIMITS.items():
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(f"{name} must be a range within {least:g}..{most:g}, low end first; got {low} {high}")
        return self


VIEW_LIMITS: Final[dict[str, Range]] = {
    "azimuth": (-720, 720),
    "distance_factor": (0.001, 100),
    "roll": (-360, 360),
    "light_azimuth": (-720, 720),
    "light_elevation": (-90, 90),
    "intensity": (0, 100),
    "ambient": (0, 1),
}
"""The widest range of each quantity of ``ViewRanges``."""

CONDITIONS: Final[dict[Conditions, ViewRanges]] = {
    "usual": ViewRanges(),
    "wide": ViewRanges(
        distance_factor=(0.7, 1.5),
        roll=(-30, 30),
        light_azimuth=(-180, 180),
        light_elevation=(15, 88),
        light_colours=((255, 214, 170), (201, 226, 255)),  # lamp light to an overcast sky
    ),
}
"""Ranges of random views by name."""


def _as_list(given: Any) -> Any:
    return [given] if isinstance(given, str | float | SupportsIndex) else given


def _not_bool(given: Any) -> Any:
    if isinstance(given, bool):
        raise ValueError(f"should be a class by name or index; got {str(given).lower()}")
    return given


ClassName = Annotated[str | int, BeforeValidator(_not_bool)]
ClassNames = Annotated[
    list[ClassName],
    BeforeValidator(_as_list, json_schema_input_type=str | int | list[str | int]),
    Field(min_length=1, max_length=64),
]


def levels_within(epsilon: float) -> int:
    """Largest change of an 8-bit channel within a budget."""
    return math.floor(epsilon * 255 + 1e-9)


def _in_order(elevation: Range) -> Range:
    low, high = elevation
    if not -90 <= low <= high <= 90:
        raise ValueError(f"must be a range within -90..90 degrees, low end first; got {low} {high}")
    return elevation


Distance = Annotated[float, Field(gt=0, le=1000)]
Elevation = Annotated[Range, AfterValidator(_in_order)]


def _one_level(epsilon: float) -> float:
    if levels_within(epsilon) < 1:
        raise ValueError(
            f"{epsilon:g} is less than 1/255 (0.0039216), one level of an 8-bit texture, so nothing could change; "
            "use 0.004 or more"
        )
    return epsilon


def _even(queries: int) -> int:
    if queries % 2:
        raise ValueError(f"queries come in pairs, one on each side of an image; got {queries}, use an even number")
    return queries


FileKind = Literal["classifier", "background", "mask"]


class _Spelling(TypedDict, total=False):
    flag: str
    metavar: str
    keyword: str
    file: FileKind
    in_form: bool


def option(default: Any = ..., help: str = "", **spelling: Unpack[_Spelling]) -> Any:
    """A field with its spelling. file: kind of the files that its values may name; in_form: the page's form has it."""
    given = {"default_factory": default} if callable(default) else {"default": default}
    info: FieldInfo = Field(description=help, **given)
    info.metadata.append(spelling)
    return info


_NETWORK: Final = "FILE_OR_NAME"
_EngineName = Annotated[str, Field(min_length=1, max_length=300)]


class VictimOptions(_Part):
    """Attacked networks."""

    classifier: str = option(
        "tiny", "victim: a .pt2 or .onnx file, or a name", metavar=_NETWORK, file="classifier", in_form=True
    )
    ensemble: list[str] = option(list, "another victim, attacked together with it", metavar=_NETWORK, file="classifier")
    queries: Annotated[int, Field(ge=2, le=10_000), AfterValidator(_even)] | None = option(
        None, "scores asked per image and step, an even number; only for a classifier without gradients (.onnx)"
    )


class PaintOptions(_Part):
    """Budget of the change."""

    epsilon: Annotated[float, Field(gt=0, le=1), AfterValidator(_one_level)] = option(
        0.05, "largest change of a texel, 0..1", in_form=True
    )
    perceptual: bool = option(
        False,
        "hide the change: less of it in plain areas, less hue, fewer texels; give a larger epsilon for the same effect",
    )
    epsilon_view: Annotated[float, Field(gt=0, le=1)] | None = option(
        None, "largest change of a pixel of the surrogate's views, 0..1 (the paper's view constraint)"
    )
    tau: Annotated[float, Field(ge=0, lt=1)] | None = option(
        None, "saliency threshold, 0..1; default: all pixels", in_form=True
    )
    keep: Annotated[float, Field(gt=0, le=1)] | None = option(
        None, "share of the texels to attack, the most effective ones; default: all texels"
    )
    materials: list[str] = option(
        list, "attack this material only; default: all materials", flag="--material", metavar="NAME"
    )
    masks: dict[str, str] = option(
        dict,
        "picture of a texture's size, white where the texture may change",
        flag="--mask",
        metavar="TEXTURE=FILE",
        file="mask",
    )


class GoalOptions(_Part):
    """Goal of the attack."""

    label: ClassNames = option(
        ...,
        "the object's true class, by name or index; each of several counts as the object",
        metavar="NAME_OR_INDEX",
        in_form=True,
    )
    target: ClassName | None = option(None, "class to be taken for; default: any other class", metavar="NAME_OR_INDEX")
    top_k: Annotated[int, Field(ge=1)] = option(1, "the true class must leave the k best classes")
    loss: Loss = option("margin", "loss to maximise")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.target is not None and self.top_k > 1:
            raise ValueError("`target` makes a class the best one, `top_k` leaves the best classes: use one of the two")
        return self


class SearchOptions(_Part):
    """Search for the change."""

    steps: Annotated[int, Field(ge=1, le=10_000)] = option(
        90, "steps at most; the attack stops once all views are safely won, on a grid also once steps gain nothing"
    )
    alpha: Annotated[float, Field(gt=0, le=1)] | None = option(
        None, "mean step size, 0..1; default: 0.01, or epsilon / 5 if smaller"
    )
    optimiser: OptimiserName = option("nesterov", "rule of a step; pgd is the paper's")
    image_pipeline: PipelineName | None = option(
        None,
        "random changes of each image before the networks: robust (size, tone, noise, JPEG), transfer (placement too, "
        "for networks left out) or none; default: transfer for an ensemble, else robust; none for grid and queries",
    )
    views_per_step: Annotated[int, Field(ge=1, le=MOST_VIEWS)] | None = option(
        None, f"views in one step; default: {VIEWS_PER_STEP} of a pool, all of the grid"
    )
    surrogate: SurrogateModel = option("auto", "colour model of the surrogate")
    seed: Annotated[int, Field(ge=0, lt=2**31)] = option(0, "the same seed and threads give equal bytes", in_form=True)


class ViewOptions(_Part):
    """Views."""

    centre: Literal["object", "origin"] | None = option(
        None,
        "point that cameras look at: the middle of the object's bounding sphere, or the origin; default: origin for "
        "the grid, else object",
    )
    distance: Distance | None = option(
        None, "camera distance in metres; default: a shipped object's own, or to fit the frame", in_form=True
    )
    elevation: Elevation | None = option(
        None, "range of camera elevations in degrees; default: a shipped object's own, or 0 50", metavar="LO HI"
    )
    background: Annotated[list[str], BeforeValidator(_as_list), Field(min_length=1, max_length=64)] = option(
        lambda: ["white"],
        "white, black, '#rrggbb' or a picture; each view draws one of several",
        metavar="COLOUR_OR_FILE",
        file="background",
        in_form=True,
    )
    pool: Annotated[int, Field(ge=1, le=MOST_VIEWS)] = option(240, "attack this many random cameras and lights")
    grid: bool = option(False, "attack the paper's grid of views in place of random ones")
    azimuths: Annotated[int, Field(ge=1, le=360)] | None = option(
        None, "columns of the grid, evenly spaced; default: the paper's six, of which 0 and 360 are the same"
    )
    elevations: Annotated[int, Field(ge=1, le=180)] = option(10, "rows of the grid")
    conditions: Conditions = option(
        "usual",
        "ranges of random views: usual, or wide (distance 0.7 to 1.5 times, rolled, light from anywhere, tinted)",
    )
    ranges: ViewRanges = option(
        ViewRanges,
        f"range of random views in place of the one in `conditions`: {', '.join(VIEW_LIMITS)}; angles in degrees",
        flag="--range",
        metavar="NAME LO HI",
    )
    held_out: Annotated[int, Field(ge=0, le=1000)] = option(60, "random views to judge on, hidden from the attack")
    renderers: Annotated[list[_EngineName], BeforeValidator(_as_list), Field(max_length=8)] = option(
        list,
        "engine of the renderers to attack, by name; several are painted for at once; default: the service's own",
        flag="--renderer",
        metavar="NAME",
    )

    @property
    def count(self) -> int:
        """Number of attacked views."""
        return (self.azimuths or PAPER_AZIMUTHS) * self.elevations if self.grid else self.pool

    @property
    def looks_at(self) -> Literal["object", "origin"]:
        """The point that cameras look at."""
        return self.centre or ("origin" if self.grid else "object")

    @model_validator(mode="before")
    @classmethod
    def _ranges_of_conditions(cls, given: Any) -> Any:
        named = given.get("conditions") if isinstance(given, Mapping) else None
        if not (isinstance(named, str) and named in CONDITIONS):
            return given
        ranges = given.get("ranges", {})
        if isinstance(ranges, ViewRanges):
            ranges = ranges.model_dump(exclude_unset=True)
        if not isinstance(ranges, Mapping):
            return given
        return {**given, "ranges": CONDITIONS[named].model_dump() | dict(ranges)}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.grid and self._changed("pool"):
            raise ValueError(f"`grid` attacks the paper's grid, `pool: {self.pool}` random views: use one of the two")
        if not self.grid and self._changed("azimuths", "elevations"):
            raise ValueError(
                "`azimuths` and `elevations` shape the paper's grid, but random views are attacked: add `grid`, or "
                "leave them out"
            )
        if self.grid and not self.held_out:
            for name in filter(self._changed, ("conditions", "ranges")):
                raise ValueError(
                    f"`{name}` is for random views, and there are none: leave it out, or ask for `held_out`"
                )
        return self

    def _changed(self, *names: str) -> bool:
        fields = type(self).model_fields
        return any(getattr(self, name) != fields[name].get_default(call_default_factory=True) for name in names)


class JudgeOptions(_Part):
    """Judges of the result that are not attacked."""

    networks: list[str] = option(
        list,
        "another classifier, which only judges",
        flag="--judge",
        metavar=_NETWORK,
        keyword="judges",
        file="classifier",
    )
    renderers: Annotated[list[_EngineName], BeforeValidator(_as_list), Field(max_length=8)] = option(
        list,
        "engine of other renderers, which only judge",
        flag="--judge-renderer",
        metavar="NAME",
        keyword="judge_renderers",
    )


class JobSpec(_Part):
    """What to attack, and how. ``object`` and networks are ids or names of stored ones."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"object": "mug", "goal": {"label": "mug"}, "paint": {"epsilon": 0.05}}]}
    )

    object: str
    goal: GoalOptions
    victim: VictimOptions = VictimOptions()
    paint: PaintOptions = PaintOptions()
    search: SearchOptions = SearchOptions()
    views: ViewOptions = ViewOptions()
    judges: JudgeOptions = JudgeOptions()

    @classmethod
    def of(cls, object: str, **options: Any) -> Self:
        """A job by keywords (``OPTIONS``). Raises ``SpecError`` for an unknown one, ``ValidationError`` for values."""
        return cls.model_validate({"object": object, **in_parts(options, cls)})

    def options(self) -> dict[str, Any]:
        """The values of all options by keyword."""
        return {keyword: option.of(self) for keyword, option in OPTIONS.items()}

    def changed(self) -> dict[str, Any]:
        """Options that differ from their defaults, by keyword; of ``ranges`` those that differ from ``conditions``."""
        usual = CONDITIONS[self.views.conditions]
        ranges = {name: value for name, value in self.views.ranges if value != getattr(usual, name)}
        found = {name: value for name, value in self.options().items() if value != OPTIONS[name].default}
        found.pop("ranges", None)
        return found | ({"ranges": ranges} if ranges else {})

    @property
    def alpha(self) -> float:
        """Mean step size."""
        return self.search.alpha or min(0.01, self.paint.epsilon / 5)

    @property
    def image_pipeline(self) -> PipelineName:
        """What happens to each image of the attack before the networks."""
        if self.search.image_pipeline is not None:
            return self.search.image_pipeline
        if self.views.grid or self.victim.queries is not None:
            return "none"
        return "transfer" if self.victim.ensemble else "robust"

    @property
    def views_per_step(self) -> int:
        """Number of views in one step."""
        count = self.views.count
        return min(count, self.search.views_per_step or (count if self.views.grid else VIEWS_PER_STEP))

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.alpha > self.paint.epsilon:
            raise ValueError(
                f"`alpha` ({self.alpha}) is a step within the budget `epsilon` ({self.paint.epsilon}); make it smaller"
            )
        return self


class QueueOptions(Schema):
    """Options of the queue. They change no result."""

    priority: Priority = Field("normal", description="interactive jobs run first, sweeps last")
    labels: Labels = Field(default_factory=dict)
    needs: Needs = Field(default_factory=Needs, description="what the job occupies: cpu, gpu, memory (GiB)")


class JobRequest(QueueOptions, JobSpec):
    """An attack to queue: its spec and options of the queue."""

    def spec(self) -> JobSpec:
        """The job alone."""
        return JobSpec.model_validate(self.model_dump(include=set(JobSpec.model_fields)))


PARTS: Final[Mapping[str, type[_Part]]] = {
    "victim": VictimOptions,
    "judges": JudgeOptions,
    "paint": PaintOptions,
    "goal": GoalOptions,
    "search": SearchOptions,
    "views": ViewOptions,
}


class Option:
    """A field of a part, and its spelling.

    keyword: name in the SDK, in experiments and in tables. flag: of the command line. metavar: placeholder of the value
    in help texts. file: kind of the files that values may name. in_form: whether the page's form has it; the others are
    for the SDK, the command line and REST. type: of a value, without constraints and without ``None``. repeated:
    whether it can be given several times. help: one phrase.
    """

    def __init__(self, part: str, field: str, info: FieldInfo) -> None:
        spelling: _Spelling = next(filter(lambda each: isinstance(each, dict), info.metadata))
        self.part, self.field, self.info = part, field, info
        self.keyword = spelling.get("keyword", field)
        self.flag = spelling.get("flag", f"--{field.replace('_', '-')}")
        self.metavar, self.file = spelling.get("metavar"), spelling.get("file")
        self.in_form = spelling.get("in_form", False)
        self.type = _plain(info.annotation)
        self.repeated = get_origin(self.type) in {list, dict} or self.type is ViewRanges
        self.help = info.description or ""

    @property
    def default(self) -> Any:
        """Default value; pydantic's ``PydanticUndefined`` for a required option."""
        return self.info.get_default(call_default_factory=True)

    def of(self, spec: JobSpec) -> Any:
        """The option's value in a job."""
        return getattr(getattr(spec, self.part), self.field)


def _plain(annotation: Any) -> Any:
    if get_origin(annotation) is Annotated:
        return _plain(get_args(annotation)[0])
    if get_origin(annotation) not in {Union, UnionType}:
        return annotation
    given = tuple(each for each in get_args(annotation) if each is not NoneType)
    return _plain(given[0]) if len(given) == 1 else Union[given]  # noqa: UP007


OPTIONS: Final[Mapping[str, Option]] = {
    option.keyword: option
    for part, model in PARTS.items()
    for option in (Option(part, name, info) for name, info in model.model_fields.items())
}
"""All options by keyword."""


def in_flags(text: str) -> str:
    """``text`` with the command line's flags in place of keywords in backquotes: `queries: 10` becomes --queries 10."""

    def flag(match: re.Match[str]) -> str:
        option = OPTIONS.get(match[1])
        return match[0] if option is None else f"{option.flag} {match[2] or ''}".rstrip()

    return re.sub(r"`(\w+)(?:: ([^`]+))?`", flag, text)


def in_parts(options: Mapping[str, Any], model: type[JobSpec] = JobRequest) -> dict[str, Any]:
    """Options by keyword as the fields of ``model``. Raises ``SpecError`` for an unknown keyword."""
    fields: dict[str, Any] = {}
    own = [name for name in model.model_fields if name not in PARTS and name != "object"]
    for keyword, value in options.items():
        if keyword in OPTIONS:
            option = OPTIONS[keyword]
            fields.setdefault(option.part, {})[option.field] = value
        elif keyword in own:
            fields[keyword] = value
        else:
            close = get_close_matches(keyword, [*OPTIONS, *own], n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"Options: {', '.join([*OPTIONS, *own])}."
            raise SpecError(f"Unknown option {keyword!r}; {hint}")
    return fields
