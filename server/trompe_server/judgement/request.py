"""What a judgement is asked for."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

from pydantic import ValidationError

from trompe_server.judgement.suites import SUITES
from trompe_shared.api import ViewOptions
from trompe_shared.errors import SpecError
from trompe_shared.faults import faults_of
from trompe_shared.geometry import colour_of

__all__ = ["VIEWS", "JudgeRequest"]

VIEWS: Final = 60
"""Default number of views, as many as a job's held-out ones."""

MOST_VIEWS: Final = 1000


@dataclass(frozen=True)
class JudgeRequest:
    """before, after: paths of model files, or names of shipped objects. label: each counts as the object.

    networks, renderers: files or names; HOST:PORT of a running renderer. epsilon: the stated budget, in [0, 1] units.
    distance (metres), elevation (degrees), background: of all views; by default those of a job. image_size: (H, W) of
    the rendered images; by default that of the first network.

    Raises ``SpecError`` for values out of range.
    """

    before: str
    after: str
    label: tuple[str | int, ...]
    networks: tuple[str, ...] = ("tiny",)
    renderers: tuple[str, ...] = ("pyrender",)
    views: int = VIEWS
    seed: int = 0
    epsilon: float | None = None
    distance: float | None = None
    elevation: tuple[float, float] | None = None
    background: str = "white"
    image_size: tuple[int, int] | None = None
    suite: str | None = None

    def __post_init__(self) -> None:
        if not self.label:
            raise SpecError("A judgement needs the object's true class: add `label`.")
        if not 0 < self.views <= MOST_VIEWS:
            raise SpecError(f"`views` must be from 1 to {MOST_VIEWS}; got {self.views}.")
        if self.epsilon is not None and not 0 < self.epsilon <= 1:
            raise SpecError(f"`epsilon` must be more than 0 and at most 1; got {self.epsilon:g}.")
        if colour_of(self.background) is None:
            raise SpecError(f"The background {self.background!r} is not a colour; use white, black or #rrggbb.")
        if self.seed < 0:
            raise SpecError(f"`seed` must be 0 or more; got {self.seed}.")
        _ = self.framing

    @cached_property
    def framing(self) -> ViewOptions:
        """Distance and elevation of the cameras. Raises ``SpecError`` for values out of range."""
        try:
            return ViewOptions(distance=self.distance, elevation=self.elevation)
        except ValidationError as error:
            raise SpecError(f"Invalid options: {'; '.join(map(str, faults_of(error)))}.") from error

    def in_suite(self, name: str) -> Self:
        """The request with the views, images, networks and renderers of a suite, and its own of the latter on top.

        Raises ``SpecError`` for an unknown suite.
        """
        if name not in SUITES:
            raise SpecError(f"There is no suite {name!r}; choose {', '.join(SUITES)}.")
        suite = SUITES[name]
        return replace(
            self,
            suite=name,
            views=suite.views,
            seed=suite.seed,
            image_size=suite.image_size,
            networks=tuple(dict.fromkeys((*suite.networks, *self.networks))),
            renderers=tuple(dict.fromkeys((*suite.renderers, *self.renderers))),
        )
