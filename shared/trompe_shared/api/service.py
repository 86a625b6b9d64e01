"""The record of jobs; stored objects, classifiers and backgrounds, which jobs name; the state of the service."""

from datetime import datetime
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, Field

from trompe_shared.api.jobs import JobSpec, Labels, Needs, Priority, Schema
from trompe_shared.api.judgements import JudgementSpec
from trompe_shared.engine import EngineInfo


class JobState(StrEnum):
    """State of a job. ``not_applicable`` (n.a.): no view was recognised before the attack, so nothing could drop."""

    queued = "queued"
    running = "running"
    succeeded = "succeeded"
    failed = "failed"
    cancelled = "cancelled"
    not_applicable = "n.a."

    @property
    def final(self) -> bool:
        """Whether the state is final."""
        return self not in {JobState.queued, JobState.running}


class Progress(Schema):
    """Progress of a job. ``fraction`` in [0, 1] is of the whole job, ``fooled`` a share of the surrogate's views."""

    phase: str = "queued"
    fraction: float = 0.0
    step: int | None = None
    steps: int | None = None
    loss: float | None = None
    fooled: float | None = None
    eta_seconds: float | None = Field(
        default=None, description="estimated seconds until the job's end, if the attack takes all its steps"
    )
    eta_least_seconds: float | None = Field(
        default=None, description="the same if the attack ends as early as it can: all views are safely won from now on"
    )


class Job(Schema):
    """An attack or a judgement on the server. ``error`` and ``note`` are for people."""

    id: str
    state: JobState
    spec: JobSpec | JudgementSpec
    names: dict[str, str] = Field(default_factory=dict, description="names of stored things in ``spec``, by id")
    priority: Priority = "normal"
    labels: Labels = Field(default_factory=dict)
    needs: Needs = Field(default_factory=Needs)
    worker: str | None = Field(None, description="worker of the latest attempt")
    created: datetime
    started: datetime | None = None
    finished: datetime | None = None
    progress: Progress = Field(default_factory=Progress)
    attempts: int = 0
    error: str | None = None
    note: str | None = None
    artifacts: list[str] = Field(default_factory=list)

    @property
    def attack(self) -> JobSpec:
        """The spec of an attack. Raises ``TypeError`` for a judgement."""
        if isinstance(self.spec, JudgementSpec):
            raise TypeError(f"Job {self.id} is a judgement, not an attack.")
        return self.spec


class JobList(Schema):
    """One page of jobs, newest first; ``next_cursor`` gets the next page."""

    jobs: list[Job]
    next_cursor: str | None = None


class _Stored(Schema):
    """What is stored under an id; ``shipped`` ones come with Trompe."""

    id: str
    name: str
    shipped: bool = False

    @property
    def reference(self) -> str:
        """Its name in a job: shipped ones keep theirs in every version, ids are of uploads."""
        return self.name if self.shipped else self.id


class ObjectInfo(_Stored):
    """A stored object. ``id`` is the hash of its archive: the same upload is stored once."""

    materials: list[str]
    textures: dict[str, tuple[int, int]] = Field(description="albedo file: (height, width) in texels")
    triangles: int
    radius: float = Field(description="metres")
    format: str = Field(default="sailenv", description="format of the upload: sailenv, obj, gltf, fbx, ply or stl")
    filename: str | None = Field(default=None, description="file name of the upload")


class ClassifierInfo(_Stored):
    """A stored classifier. ``white_box`` classifiers give gradients; the others give scores only."""

    white_box: bool
    image_size: tuple[int, int] = Field(description="(height, width) of its input")
    n_classes: int
    classes: list[str] | None = Field(None, description="class names in the order of the logits, if known")


class BackgroundInfo(Schema):
    """A stored background picture; a job names it by ``id``."""

    id: str
    name: str


class WorkerInfo(Schema):
    """An attack worker: a process of one machine, or a node of a cluster. ``jobs`` run there unless ``fault``."""

    id: str
    host: str
    device: str
    alive: bool
    started: datetime
    seen: datetime
    jobs: list[str] = Field(default_factory=list)
    fault: str | None = None


class RendererInfo(Schema):
    """A renderer worker. ``alive``: it accepts connections. Its engine's fields are null where it does not answer."""

    address: str = Field(description="host:port")
    alive: bool
    engine: str | None = Field(default=None, description="name of the engine, as in a job's option ``renderers``")
    version: str | None = Field(default=None, description="of the engine")
    settings: str | None = Field(default=None, description="of the engine, where they change pictures")

    @property
    def identity(self) -> str | None:
        """The engine with version and settings, as a job's option ``renderers`` takes it."""
        return str(EngineInfo(self.engine, self.version or "", self.settings or "")) if self.engine else None


class ExperimentInfo(Schema):
    """Number of jobs by state with the label ``experiment=<name>``. ``created`` is the time of the first one."""

    name: str
    jobs: dict[JobState, int]
    created: datetime


class Event(Schema):
    """One line of a job's history; ``id`` grows by one, and SSE clients resume from it."""

    id: int
    time: datetime
    state: JobState
    progress: Progress
    message: str | None = None


class Problem(BaseModel):
    """Problem details (RFC 9457). ``errors`` lists the faults field by field, if any."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str | None = None
    instance: str | None = None
    request_id: str | None = None
    errors: list[dict[str, Any]] | None = None
