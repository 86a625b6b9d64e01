"""The HTTP contract: what client and server send each other. Needs pydantic alone."""

import math
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

__all__ = [
    "FEW_RECOGNISED",
    "SUN_LIMITS",
    "VIEWS_PER_PLACE",
    "VIEWS_PER_STEP",
    "VIEW_LIMITS",
    "Accuracy",
    "AttackOn",
    "BackgroundInfo",
    "ClassifierInfo",
    "Event",
    "ExperimentInfo",
    "Job",
    "JobList",
    "JobRequest",
    "JobSpec",
    "JobState",
    "Judgement",
    "LightFound",
    "Loss",
    "ObjectInfo",
    "Optimiser",
    "Priority",
    "Problem",
    "Progress",
    "RendererInfo",
    "Result",
    "SaliencyScope",
    "SunRanges",
    "SurrogateModel",
    "VerticesMoved",
    "ViewFidelity",
    "ViewPrediction",
    "ViewRanges",
    "WorkerInfo",
    "levels_within",
]

AttackOn = Literal["texture", "light", "vertices"]
SurrogateModel = Literal["auto", "diffuse", "calibrated", "curve"]
Optimiser = Literal["fgsm", "pgd", "momentum", "nesterov", "adam", "auto"]
Loss = Literal["margin", "cross_entropy", "dlr"]
SaliencyScope = Literal["all_views", "each_view"]
Priority = Literal["interactive", "normal", "sweep"]
Needs = Literal["any", "cpu", "cuda"]
Labels = Annotated[
    dict[
        Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,62}$")],
        Annotated[str, Field(min_length=1, max_length=200)],
    ],
    Field(max_length=32, description="names of your own and their values, to find jobs by"),
]
Range = tuple[float, float]
Colour = tuple[
    Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)]
]


class _Schema(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ObjectInfo(_Schema):
    """A stored object. ``id`` is the hash of its archive, so that the same upload is stored once."""

    id: str
    name: str
    materials: list[str]
    textures: dict[str, tuple[int, int]] = Field(description="albedo file: (height, width) in texels")
    triangles: int
    radius: float = Field(description="metres")
    format: str = Field(default="sailenv", description="what it came in: sailenv, obj, gltf, fbx, ply or stl")
    filename: str | None = Field(default=None, description="name of the file that it was uploaded as")
    shipped: bool = False


class ClassifierInfo(_Schema):
    """A stored classifier. ``white_box`` classifiers give gradients and can be attacked; the others only judge."""

    id: str
    name: str
    white_box: bool
    image_size: tuple[int, int] = Field(description="(height, width) of its input")
    n_classes: int
    classes: list[str] | None = Field(None, description="class names in the order of the logits, where known")
    shipped: bool = False


class BackgroundInfo(_Schema):
    """A stored picture that views can have behind the object; a job names it by ``id``."""

    id: str
    name: str


class ViewRanges(_Schema):
    """What random views are drawn from, each quantity uniformly within its range (low, high); angles in degrees."""

    azimuth: Range = (0.0, 360.0)
    distance_factor: Range = Field(default=(0.9, 1.1), description="the job's distance is multiplied by it")
    roll: Range = (0.0, 0.0)
    light_azimuth: Range = (-70.0, 70.0)
    light_elevation: Range = (35.0, 88.0)
    intensity: Range = Field(default=(1.25, 1.25), description="1 lights a white surface that faces the light white")
    ambient: Range = Field(default=(0.5, 0.5), description="share of white that reaches every surface from everywhere")
    light_colours: tuple[Colour, Colour] = Field(
        default=((255, 255, 255), (255, 255, 255)),
        description="ends of the line, in linear light, that colours are drawn from",
    )

    @model_validator(mode="after")
    def _in_order(self) -> "ViewRanges":
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


class SunRanges(_Schema):
    """Where an attack on the light may put it, and how strong; degrees, 360 of azimuth are a full circle."""

    azimuth: Range = (-180.0, 180.0)
    elevation: Range = (15.0, 88.0)
    intensity: Range | None = Field(default=None, description="searched too where given; null: each view keeps its own")
    ambient: Range | None = Field(default=None, description="searched too where given; null: each view keeps its own")

    @model_validator(mode="after")
    def _in_order(self) -> "SunRanges":
        for name, (least, most) in SUN_LIMITS.items():
            low, high = getattr(self, name) or (least, most)
            if not least <= low <= high <= most:
                raise ValueError(f"{name} must be a range within {least:g}..{most:g}, low end first; got {low} {high}")
        return self


SUN_LIMITS: Final[dict[str, Range]] = {
    "azimuth": VIEW_LIMITS["light_azimuth"],
    "elevation": VIEW_LIMITS["light_elevation"],
    "intensity": VIEW_LIMITS["intensity"],
    "ambient": VIEW_LIMITS["ambient"],
}
"""The widest range of each quantity of ``SunRanges``."""


def _as_list(given: Any) -> Any:
    return [given] if isinstance(given, str) else given


VIEWS_PER_STEP: Final = 40
"""Views of a pool that one step looks at, where the job does not say."""

VIEWS_PER_PLACE: Final = 12
"""Views on which each place of the light is tried, where the job does not say."""

_TEXTURE_ONLY: Final = (
    *("epsilon", "tau", "saliency_scope", "keep", "materials", "masks", "epsilon_view", "loss", "optimiser"),
    *("restarts", "queries", "surrogate", "diverse"),
)
_OPTIONS_OF: Final[dict[str, tuple[str, ...]]] = {
    "texture": _TEXTURE_ONLY,
    "light": ("sun",),
    "vertices": ("vertex_budget",),
}
"""Options of a job that mean something for one kind of attack alone."""


def levels_within(epsilon: float) -> int:
    """The largest change of an 8-bit channel that is within a budget."""
    return math.floor(epsilon * 255 + 1e-9)


def _worth_saving(epsilon: float) -> float:
    if levels_within(epsilon) < 1:
        raise ValueError(
            f"{epsilon:g} is less than 1/255 (0.0039216), one level of an 8-bit texture, so that nothing could change; "
            "make it 0.004 or more"
        )
    return epsilon


def _mean_step(epsilon: float) -> float:
    """The default of ``alpha``."""
    return min(0.01, max(epsilon / 5, 1e-9))


class JobSpec(_Schema):
    """What to attack, and how. ``object`` and ``classifier`` are ids or names of stored ones."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"object": "mug", "label": "mug", "classifier": "tiny", "epsilon": 0.05}]},
    )

    object: str
    label: str | int = Field(description="the object's true class: a name or an index")
    classifier: str = "tiny"
    ensemble: list[str] = Field(
        default_factory=list, description="classifiers that are attacked together with it, for transfer to others"
    )
    judges: list[str] = Field(default_factory=list, description="other classifiers that judge the result")
    diverse: bool = Field(
        False,
        description="for transfer to other classifiers: show images scaled, shifted and mirrored at random, and win "
        "each view by as much as possible. Never ends before all steps are taken. By default true of a texture that "
        "is attacked through the gradients of an ensemble, else false",
    )
    attack_on: AttackOn = Field(
        "texture",
        description="what may change: the object's texture, where its main light stands, or (slightly) its vertices",
    )
    sun: SunRanges = Field(SunRanges(), description="of light: where it may stand")
    vertex_budget: Annotated[float, Field(gt=0, le=0.5)] = Field(
        0.02, description="of vertices: how far one may move, as a share of the object's radius"
    )
    epsilon: Annotated[float, Field(gt=0, le=1), AfterValidator(_worth_saving)] = 0.05
    alpha: Annotated[float, Field(gt=0, le=1)] = Field(
        0.01,
        description="mean step; by default 0.01, or a fifth of epsilon where that is smaller; fgsm and auto have none",
    )
    tau: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="saliency threshold; null attacks all texels"
    )
    saliency_scope: SaliencyScope = Field(
        "all_views",
        description="of tau: saliency is rescaled over all views together, as in the paper; or every view by its own "
        "largest, so that a view in which the loss is little sensitive gives pixels too",
    )
    keep: Annotated[float, Field(gt=0, le=1)] | None = Field(
        None,
        description="attack only this share of the texels, those with which two short attacks get furthest; null "
        "attacks all",
    )
    materials: list[str] = Field(default_factory=list, description="attack only these materials' textures")
    masks: dict[str, str] = Field(
        default_factory=dict,
        description="by texture file, the id of an uploaded picture of its size that is white where it may change",
    )
    epsilon_view: Annotated[float, Field(gt=0, le=1)] | None = Field(
        None, description="largest change of a pixel of the surrogate's views (the paper's view constraint)"
    )
    target_label: str | int | None = Field(
        None, description="the class to be taken for, a name or an index; null: anything but the label"
    )
    top_k: Annotated[int, Field(ge=1)] = Field(1, description="the true class must leave this many best ones")
    loss: Loss = "margin"
    optimiser: Optimiser = "nesterov"
    restarts: Annotated[int, Field(ge=0, le=100)] = Field(0, description="further runs, which share the steps")
    queries: Annotated[int, Field(ge=2, le=10_000)] | None = Field(
        None, description="scores asked per image and step, of a classifier that gives no gradients"
    )
    surrogate: SurrogateModel = "auto"
    steps: Annotated[int, Field(ge=1, le=10_000)] = Field(
        90,
        description="at most so many; the attack on a texture ends sooner where all views are safely won, unless it is "
        "diverse. "
        "Of light: places that are tried",
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    distance: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        None, description="metres; null is the shipped object's own, else it fills the frame"
    )
    elevation: tuple[float, float] | None = Field(
        None, description="range of camera elevations, degrees; null is the shipped object's own, else 0 to 50"
    )
    background: Annotated[list[str], BeforeValidator(_as_list), Field(min_length=1, max_length=64)] = Field(
        ["white"],
        description="'white', 'black', '#rrggbb' or the id of an uploaded picture; each view draws one where there are "
        "several",
    )
    azimuths: Annotated[int, Field(ge=1, le=360)] = Field(6, description="columns of the paper's grid of views")
    elevations: Annotated[int, Field(ge=1, le=180)] = Field(10, description="rows of the paper's grid of views")
    pool: Annotated[int, Field(ge=0, le=2000)] = Field(
        240,
        description="attack this many random cameras and lights; 0: the paper's grid of views",
    )
    views_per_step: Annotated[int, Field(ge=1, le=2000)] | None = Field(
        None,
        description="views that a step looks at, drawn anew each time; null: 40 of a pool, all of the grid. "
        "Of light: random views on which all places are tried, and which judge nothing; null: 12",
    )
    ranges: ViewRanges = Field(ViewRanges(), description="what pool and held-out views are drawn from")
    held_out: Annotated[int, Field(ge=0, le=1000)] = Field(60, description="held-out views the result is judged on")

    @property
    def n_views(self) -> int:
        """How many views are attacked."""
        return self.pool or self.azimuths * self.elevations

    @property
    def n_views_per_step(self) -> int:
        """How many of them a step looks at; of light: on how many others each place is tried."""
        if self.attack_on == "light":
            return self.views_per_step or VIEWS_PER_PLACE
        return min(self.n_views, self.views_per_step or (VIEWS_PER_STEP if self.pool else self.n_views))

    @model_validator(mode="before")
    @classmethod
    def _small_steps_in_a_small_budget(cls, given: Any) -> Any:
        if isinstance(given, dict) and "alpha" not in given and isinstance(given.get("epsilon"), float):
            return given | {"alpha": _mean_step(given["epsilon"])}
        return given

    @model_validator(mode="before")
    @classmethod
    def _an_ensemble_is_for_transfer(cls, given: Any) -> Any:
        if not isinstance(given, dict) or "diverse" in given or not given.get("ensemble"):
            return given
        by_gradients = given.get("queries") is None
        return given | {"diverse": by_gradients and given.get("attack_on", "texture") == "texture"}

    @model_validator(mode="after")
    def _consistent(self) -> "JobSpec":
        low, high = self.elevation or (0.0, 0.0)
        if not -90 <= low <= high <= 90:
            raise ValueError(f"elevation must be a range within -90..90 degrees, low end first; got {low} {high}")
        if self.alpha > self.epsilon:
            raise ValueError(
                f"alpha ({self.alpha}) is the step within the budget epsilon ({self.epsilon}); make it smaller"
            )
        if self.target_label is not None and self.top_k > 1:
            raise ValueError(
                "top_k is about leaving the best classes, target_label about becoming the best: choose one"
            )
        if self.queries is not None and self.queries % 2:
            raise ValueError(f"queries come in pairs, on both sides of an image; got {self.queries}, make it even")
        return self

    @model_validator(mode="after")
    def _steps_for_every_run(self) -> "JobSpec":
        runs = self.restarts + 1
        if self.steps < runs:
            raise ValueError(
                f"steps ({self.steps}) are too few for {self.restarts} restarts: each run needs one at least; "
                f"make steps {runs} or more"
            )
        if self.optimiser == "fgsm" and self.steps != runs:
            raise ValueError(
                f"fgsm is a single step: make steps {runs} (one a run) instead of {self.steps}, or choose another "
                "optimiser, such as pgd"
            )
        return self

    @model_validator(mode="after")
    def _nothing_without_effect(self) -> "JobSpec":
        foreign = [name for kind, names in _OPTIONS_OF.items() if kind != self.attack_on for name in names]
        idle = [name for name in foreign if getattr(self, name) != _default_of(name)]
        if self.attack_on != "texture" and self.alpha != _mean_step(self.epsilon):
            idle.append("alpha")
        if idle:
            raise ValueError(
                f"attack_on is {self.attack_on!r}, and {', '.join(idle)} belong to another kind of attack: leave them "
                "out, or change attack_on"
            )
        if self.tau is None and self.saliency_scope != _default_of("saliency_scope"):
            raise ValueError(
                "saliency_scope says how saliency is rescaled for tau, and there is no tau: give one, or leave it out"
            )
        return self


def _default_of(option: str) -> Any:
    return JobSpec.model_fields[option].get_default(call_default_factory=True)


_CHOOSE_THEIR_STEP: Final = ("fgsm", "auto")
"""Optimisers without ``alpha``."""


class JobRequest(JobSpec):
    """A job to be queued: what to attack, and what the queue must know. The latter changes no result."""

    priority: Priority = Field("normal", description="interactive jobs come first, sweeps last")
    labels: Labels = Field(default_factory=dict)
    needs: Needs = Field("any", description="what the worker that takes it must compute on")

    @model_validator(mode="after")
    def _nothing_is_ignored(self) -> "JobRequest":
        """Options that would change nothing. Of a request alone: jobs that were taken before stay what they were."""
        if self.optimiser in _CHOOSE_THEIR_STEP and self.alpha != _mean_step(self.epsilon):
            raise ValueError(
                f"alpha ({self.alpha:g}) is a step's size, and {self.optimiser} chooses its own: leave it out, or "
                "choose another optimiser, such as nesterov"
            )
        if self.pool and (self.azimuths, self.elevations) != (_default_of("azimuths"), _default_of("elevations")):
            raise ValueError(
                f"azimuths and elevations shape the paper's grid, and {self.pool} random views (pool) are attacked in "
                "its place: ask for the grid (pool 0, or --grid), or leave them out"
            )
        drawn = self.pool or self.held_out or self.attack_on == "light"
        if not drawn and self.ranges != _default_of("ranges"):
            raise ValueError(
                "ranges say what random views are drawn from, and there are none: pool and held_out are 0. Ask for "
                "some, or leave the ranges out"
            )
        return self

    @classmethod
    def of(cls, spec: JobSpec) -> "JobRequest":
        """``spec`` as a request, with the defaults of what it leaves open. It is not checked anew: a job that was taken
        before may have what is refused today."""
        return cls.model_construct(**dict(spec))

    def spec(self) -> JobSpec:
        """The job alone."""
        return JobSpec.model_validate(self.model_dump(include=set(JobSpec.model_fields)))


class JobState(StrEnum):
    """States of a job. ``not_applicable`` (n.a.): no view was recognised before the attack, so nothing could drop."""

    queued = "queued"
    running = "running"
    succeeded = "succeeded"
    failed = "failed"
    cancelled = "cancelled"
    not_applicable = "n.a."

    @property
    def final(self) -> bool:
        """Whether a job in this state will never change again."""
        return self not in {JobState.queued, JobState.running}


class Progress(_Schema):
    """Where a job is. ``fraction`` in [0, 1] is over the whole job, ``fooled`` is of the surrogate's views."""

    phase: str = "queued"
    fraction: float = 0.0
    step: int | None = None
    steps: int | None = None
    loss: float | None = None
    fooled: float | None = None
    eta_seconds: float | None = Field(default=None, description="seconds until the job's end, as far as one can tell")


class Job(_Schema):
    """A job as the server knows it. ``error`` and ``note`` are for people."""

    id: str
    state: JobState
    spec: JobSpec
    priority: Priority = "normal"
    labels: Labels = Field(default_factory=dict)
    needs: Needs = "any"
    worker: str | None = Field(None, description="the worker that runs it, or ran it last")
    created: datetime
    started: datetime | None = None
    finished: datetime | None = None
    progress: Progress = Field(default_factory=Progress)
    attempts: int = 0
    error: str | None = None
    note: str | None = None
    artifacts: list[str] = Field(default_factory=list)


class JobList(_Schema):
    """One page of jobs, newest first; pass ``next_cursor`` to get the page after it."""

    jobs: list[Job]
    next_cursor: str | None = None


class WorkerInfo(_Schema):
    """A process that runs jobs, as its last heartbeat told. ``job`` is the one that it works on."""

    id: str
    host: str
    device: str
    alive: bool
    started: datetime
    seen: datetime
    job: str | None = None


class RendererInfo(_Schema):
    """A renderer worker. ``alive``: it accepts connections."""

    address: str = Field(description="host:port")
    alive: bool


class ExperimentInfo(_Schema):
    """The jobs with the label ``experiment=<name>``, counted by state. ``created`` is the time of the first one."""

    name: str
    jobs: dict[JobState, int]
    created: datetime


class Event(_Schema):
    """One line of a job's history; ``id`` grows by one and is what SSE clients resume from."""

    id: int
    time: datetime
    state: JobState
    progress: Progress
    message: str | None = None


FEW_RECOGNISED: Final = 0.3
"""An ``a_before`` below this is worth a warning: few views are left for ``a_drop`` to rest on. It counts in no mean."""


class Accuracy(_Schema):
    """Share of views classified as the object's class, before and after; intervals are Wilson's at 95 %.

    What stands after the attack is null where there was none.
    """

    views: int
    a_before: float
    a_after: float | None
    a_drop: float | None = Field(description="(a_before - a_after) / a_before; null (n.a.) when a_before is 0")
    a_drop_interval: tuple[float, float] | None = Field(
        None, description="95 % bootstrap interval over views; null where a_drop is"
    )
    a_before_interval: tuple[float, float]
    a_after_interval: tuple[float, float] | None


class ViewFidelity(_Schema):
    """How well the surrogate predicted the target in one view: the unpainted object, and what the attack changed."""

    error: float = Field(description="mean |difference| on the pixels of the unpainted object, sRGB in [0, 1] units")
    correlation: float = Field(description="of predicted and true change of the image")
    slope: float = Field(description="of true over predicted change; 1 where it is as large as predicted")
    explained: float = Field(description="share of the variance of the true change that the prediction explains")
    change: float = Field(description="root of the mean squared true change, sRGB in [0, 1] units")


class ViewPrediction(_Schema):
    """What the classifier said of one view, before and after; probabilities in [0, 1]."""

    azimuth: float
    elevation: float
    distance: float
    light_azimuth: float
    light_elevation: float
    roll: float = 0.0
    light_intensity: float = 1.25
    light_ambient: float = 0.5
    light_colour: Colour = (255, 255, 255)
    background: str = Field("#ffffff", description="its colour, or the id of the picture behind the object")
    before: int
    before_confidence: float
    before_true_confidence: float
    after: int | None = None
    after_confidence: float | None = None
    after_true_confidence: float | None = None
    fidelity: Annotated[
        ViewFidelity | None,
        Field(description="of an attacked view whose image changed, where the texture was attacked"),
    ] = None


class Judgement(_Schema):
    """What another classifier says of the same target images."""

    classifier: str
    target: Accuracy
    held_out: Accuracy | None = None


class LightFound(_Schema):
    """The light that fools most of what was tried; degrees. What is null stayed each view's own."""

    azimuth: float
    elevation: float
    intensity: float | None
    ambient: float | None
    fooled: float = Field(description="share of the views that it was tried on that were fooled")
    tried_on: int = Field(description="views that it was tried on; they are in none of the other figures")


class VerticesMoved(_Schema):
    """How far an object's vertices moved, as it is saved."""

    largest: float = Field(description="metres")
    largest_share: float = Field(description="the same as a share of the object's radius")
    mean: float = Field(description="over corners of faces, metres")


class Result(_Schema):
    """``result.json``: what was asked, what came out, and how well surrogate and target agree."""

    spec: JobSpec = Field(description="what was asked")
    object: str
    label: int
    label_name: str | None
    classifier: str
    ensemble: list[str] = Field(default_factory=list, description="classifiers that were attacked together with it")
    epsilon: float = Field(description="0 where the texture was not attacked; so is alpha")
    alpha: float
    tau: float | None
    surrogate_model: str
    surrogate_reason: str
    seed: int
    steps: int = Field(description="steps that the attack took, or places of the light that it tried")
    image_size: tuple[int, int]
    surrogate: Accuracy | None
    target: Accuracy
    held_out: Accuracy | None
    transfer_gap: float | None = Field(description="surrogate a_drop minus target a_drop on the same views")
    judges: list[Judgement] = Field(default_factory=list)
    goal_reached: float | None = Field(
        None, description="share of the target views on which the attack's goal is reached after it"
    )
    light: LightFound | None = Field(None, description="where the light was attacked")
    vertices: VerticesMoved | None = Field(None, description="where vertices were attacked")
    texels_altered: float | None = Field(
        description="share of texels the attack altered (N%); null where the texture was not attacked"
    )
    mean_texel_change: float | None = Field(description="mean |change| over altered texels and channels, [0, 1] units")
    max_view_change: float | None = Field(description="largest |change| of a pixel of a target view, [0, 1] units")
    pixels_beyond_epsilon: float | None = Field(
        None, description="share of the object's pixels in target views that changed by more than epsilon"
    )
    views_beyond_epsilon: float | None = Field(None, description="share of the target views that hold such a pixel")
    ssim: float | None = Field(
        None, description="mean structural similarity of target views before and after, over the object; 1 is equal"
    )
    ssim_worst: float | None = Field(None, description="the same of the worst view")
    delta_e: float | None = Field(None, description="mean CIEDE2000 colour difference over the object's pixels")
    delta_e_95: float | None = Field(None, description="95 % of the object's pixels differ by less")
    texture_variation: float | None = Field(
        None, description="mean |difference| of the change between neighbouring texels, [0, 1] units"
    )
    evaluations: int | None = Field(
        None,
        description="images that the attack showed each classifier it attacked, those by which it chose pixels (tau), "
        "texels (keep) and backgrounds too",
    )
    queries: int | None = Field(None, description="scores asked of a classifier that gives no gradients")
    fidelity: dict[str, float] = Field(
        default_factory=dict,
        description="surrogate against target, of a random repaint on a few trial views; see docs/glossary.md",
    )
    warnings: list[str] = Field(default_factory=list)
    seconds: dict[str, float]
    probe_renders: int
    versions: dict[str, str]
    views: list[ViewPrediction]
    held_out_views: list[ViewPrediction]


class Problem(BaseModel):
    """Problem details (RFC 9457). ``errors`` lists what is wrong field by field, where there are fields."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str | None = None
    instance: str | None = None
    request_id: str | None = None
    errors: list[dict[str, Any]] | None = None
