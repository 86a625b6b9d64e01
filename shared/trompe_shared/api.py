"""The HTTP contract: what client and server send each other. Needs pydantic alone."""

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = [
    "Accuracy",
    "BackgroundInfo",
    "ClassifierInfo",
    "Event",
    "Job",
    "JobList",
    "JobSpec",
    "JobState",
    "Judgement",
    "ObjectInfo",
    "Problem",
    "Progress",
    "Result",
    "SurrogateModel",
    "ViewPrediction",
]

SurrogateModel = Literal["auto", "diffuse", "calibrated", "curve"]


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


class JobSpec(_Schema):
    """What to attack, and how. ``object`` and ``classifier`` are ids or names of stored ones."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"object": "mug", "label": "mug", "classifier": "tiny", "epsilon": 0.05}]},
    )

    object: str
    label: str | int = Field(description="the object's true class: a name or an index")
    classifier: str = "tiny"
    judges: list[str] = Field(default_factory=list, description="other classifiers that judge the result")
    epsilon: Annotated[float, Field(gt=0, le=1)] = 0.05
    alpha: Annotated[float, Field(gt=0, le=1)] = Field(
        0.01, description="mean step; by default 0.01, or a fifth of epsilon where that is smaller"
    )
    tau: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="saliency threshold; null attacks all texels"
    )
    surrogate: SurrogateModel = "auto"
    steps: Annotated[int, Field(ge=1, le=10_000)] = 20
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    distance: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        None, description="metres; null is the shipped object's own, else it fills the frame"
    )
    elevation: tuple[float, float] | None = Field(
        None, description="range of camera elevations, degrees; null is the shipped object's own, else 0 to 50"
    )
    background: str = Field("white", description="'white', 'black', '#rrggbb' or the id of an uploaded picture")
    azimuths: Annotated[int, Field(ge=1, le=360)] = Field(6, description="columns of the paper's grid of views")
    elevations: Annotated[int, Field(ge=1, le=180)] = Field(10, description="rows of the paper's grid of views")
    pool: Annotated[int, Field(ge=0, le=2000)] = Field(
        0, description="attack this many random cameras and lights in place of the grid; each step draws 40 of them"
    )
    held_out: Annotated[int, Field(ge=0, le=1000)] = Field(60, description="held-out views the result is judged on")

    @model_validator(mode="before")
    @classmethod
    def _small_steps_in_a_small_budget(cls, given: Any) -> Any:
        if isinstance(given, dict) and "alpha" not in given and isinstance(given.get("epsilon"), float):
            return given | {"alpha": min(0.01, max(given["epsilon"] / 5, 1e-9))}
        return given

    @model_validator(mode="after")
    def _consistent(self) -> "JobSpec":
        low, high = self.elevation or (0.0, 0.0)
        if not -90 <= low <= high <= 90:
            raise ValueError(f"elevation must be a range within -90..90 degrees, low end first; got {low} {high}")
        if self.alpha > self.epsilon:
            raise ValueError(
                f"alpha ({self.alpha}) is the step within the budget epsilon ({self.epsilon}); make it smaller"
            )
        return self


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


class Job(_Schema):
    """A job as the server knows it. ``error`` and ``note`` are for people."""

    id: str
    state: JobState
    spec: JobSpec
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


class Event(_Schema):
    """One line of a job's history; ``id`` grows by one and is what SSE clients resume from."""

    id: int
    time: datetime
    state: JobState
    progress: Progress
    message: str | None = None


class Accuracy(_Schema):
    """Share of views classified as the object's class, before and after; intervals are Wilson's at 95 %.

    What stands after the attack is null where there was none.
    """

    views: int
    a_before: float
    a_after: float | None
    a_drop: float | None = Field(description="(a_before - a_after) / a_before; null (n.a.) when a_before is 0")
    a_before_interval: tuple[float, float]
    a_after_interval: tuple[float, float] | None


class ViewPrediction(_Schema):
    """What the classifier said of one view, before and after; probabilities in [0, 1]."""

    azimuth: float
    elevation: float
    distance: float
    light_azimuth: float
    light_elevation: float
    before: int
    before_confidence: float
    before_true_confidence: float
    after: int | None = None
    after_confidence: float | None = None
    after_true_confidence: float | None = None


class Judgement(_Schema):
    """What another classifier says of the same target images."""

    classifier: str
    target: Accuracy
    held_out: Accuracy | None = None


class Result(_Schema):
    """``result.json``: what was asked, what came out, and how well surrogate and target agree."""

    object: str
    label: int
    label_name: str | None
    classifier: str
    epsilon: float
    alpha: float
    tau: float | None
    surrogate_model: str
    surrogate_reason: str
    seed: int
    steps: int
    image_size: tuple[int, int]
    surrogate: Accuracy | None
    target: Accuracy
    held_out: Accuracy | None
    transfer_gap: float | None = Field(description="surrogate a_drop minus target a_drop on the same views")
    judges: list[Judgement] = Field(default_factory=list)
    texels_altered: float | None = Field(description="share of texels the attack altered (N%)")
    mean_texel_change: float | None = Field(description="mean |change| over altered texels and channels, [0, 1] units")
    max_view_change: float | None = Field(description="largest |change| of a pixel of a target view, [0, 1] units")
    fidelity: dict[str, float] = Field(
        default_factory=dict, description="surrogate against target; see docs/glossary.md"
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
