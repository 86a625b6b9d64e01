"""What a judgement of two objects is asked for."""

from typing import Annotated, Any, Final, Self

from pydantic import ConfigDict, Field, ValidationError, model_validator

from trompe_shared.api.jobs import ClassNames, Distance, Elevation, Option, QueueOptions, Schema, option
from trompe_shared.colours import colour_of
from trompe_shared.errors import SpecError
from trompe_shared.faults import faults_of

JOB_RESULT: Final = "job:"
"""Begins the name of a job's result, as ``job:8f14e45fceea167a``."""

MOST_VIEWS: Final = 1000


_Names = Annotated[list[str], Field(max_length=16)]


class JudgementSpec(Schema):
    """What to judge, and how.

    ``before`` and ``after`` name shipped or stored objects, and ``after`` may be a job's result (``job:ID``). A
    judgement on one machine, without a service, also takes paths of files.
    """

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={"examples": [{"before": "mug", "after": "job:8f14e45fceea167a", "label": "mug"}]},
    )

    before: str = Field(min_length=1)
    after: str = Field(min_length=1, description="the object of `before`, repainted by anyone")
    label: ClassNames = Field(description="each class counts as the object")
    networks: _Names = option(
        [], "network; default: the shipped one, or the suite's", flag="--network", metavar="FILE_OR_NAME"
    )
    renderers: _Names = option(
        [], "engine, or HOST:PORT on one machine; default: the first, or the suite's", flag="--renderer", metavar="NAME"
    )
    views: Annotated[int, Field(ge=1, le=MOST_VIEWS)] | None = option(None, "random views; default: 60")
    seed: Annotated[int, Field(ge=0, lt=2**31)] | None = option(None, "of the views; default: 0")
    epsilon: Annotated[float, Field(gt=0, le=1)] | None = option(None, "the stated budget, 0..1")
    distance: Distance | None = option(None, "of the cameras, metres; default: as for an attack")
    elevation: Elevation | None = option(None, "of the cameras, degrees; default: as for an attack", metavar="LO HI")
    background: str = option("white", "white, black or '#rrggbb'", metavar="COLOUR")
    suite: str | None = option(
        None, "fixes views and seed, and adds networks and renderers: standard-1", metavar="NAME"
    )

    @classmethod
    def of(cls, before: str, after: str, **options: Any) -> Self:
        """A judgement by keywords. Raises ``SpecError``."""
        try:
            return cls.model_validate({"before": before, "after": after, **options})
        except ValidationError as error:
            raise SpecError(f"Invalid options: {'; '.join(map(str, faults_of(error)))}.") from error

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if colour_of(self.background) is None:
            raise ValueError(f"the background {self.background!r} is not a colour; use white, black or #rrggbb")
        if self.suite is not None and (self.views is not None or self.seed is not None):
            raise ValueError(f"the suite {self.suite} fixes views and seed: leave them out")
        return self


class JudgementRequest(QueueOptions, JudgementSpec):
    """A judgement to queue: its spec and options of the queue."""

    def spec(self) -> JudgementSpec:
        """The judgement alone."""
        return JudgementSpec.model_validate(self.model_dump(include=set(JudgementSpec.model_fields)))


JUDGEMENT_OPTIONS: Final = [
    Option("judgement", name, info)
    for name, info in JudgementSpec.model_fields.items()
    if name not in {"before", "after", "label"}
]
"""Options with a flag made from their field."""
