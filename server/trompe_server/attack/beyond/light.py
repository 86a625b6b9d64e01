"""Where may the sun stand to fool a classifier? A search over the main light, common to all views; the object stays.

The target itself is asked, on a few of the attack's own views: a coarse sweep of the ranges, then ever narrower ones
around the best place so far. Gradients through Lambert's law with the target's own albedo take about twice as long
(each image goes through the classifier forward and back, from several starts) and ended no higher where both were
measured (``bench/beyond.py``).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack.beyond.chance import chances
from trompe_server.attack.goal import Goal
from trompe_server.classifiers import Classifier
from trompe_shared.api import SUN_LIMITS
from trompe_shared.errors import SpecError
from trompe_shared.geometry import View

__all__ = ["FoundLight", "LightPlace", "LightRanges", "LightTrial", "find_light", "load_light", "save_light"]

Range = tuple[float, float]
Image8 = NDArray[np.uint8]
Ask = Callable[[Sequence[View]], Image8]
"""Asks the target for images of the object, (views, H, W, 3) uint8."""

PLACES: Final = 56
"""Places of a whole search: those of the coarse sweep, and those of the rounds."""

NARROWER: Final = 3
"""Rounds around the best place; the box is half as wide each time."""

AROUND: Final = 8
"""Places of each such round."""


@dataclass(frozen=True)
class LightPlace:
    """Where the main light shines from, degrees; ``None`` leaves intensity or ambient as each view has it."""

    azimuth: float
    elevation: float
    intensity: float | None = None
    ambient: float | None = None

    def light_up(self, views: Sequence[View]) -> list[View]:
        """``views`` under this light; its colour, and what is ``None``, stay their own."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return [replace(view, light=replace(view.light, **given)) for view in views]


@dataclass(frozen=True)
class LightRanges:
    """Where the light may stand, degrees, low end first. An azimuth range of 360 or more is a full circle.

    ``intensity`` and ``ambient``, where given, are searched too. Raises ``SpecError`` for ranges beyond what there is
    or with their ends exchanged.
    """

    azimuth: Range = (-180.0, 180.0)
    elevation: Range = (15.0, 88.0)
    intensity: Range | None = None
    ambient: Range | None = None

    def __post_init__(self) -> None:
        for name, (low, high) in self.given.items():
            least, most = SUN_LIMITS[name]
            if not least <= low <= high <= most:
                raise SpecError(
                    f"The light's {name} must be a range within {least:g}..{most:g}, low end first; got {low} {high}."
                )

    @property
    def given(self) -> dict[str, Range]:
        """What is searched, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def place(self, shares: NDArray[np.float64]) -> LightPlace:
        """The place at ``shares`` of the ranges, (dimensions,): 0 is the low end, 1 the high one.

        Beyond an end counts as that end, on a full circle as having gone round. Equal shares of azimuth and elevation
        are equal areas of the sky.
        """
        values = {}
        for share, (name, (low, high)) in zip(shares, self.given.items(), strict=True):
            within = share % 1.0 if name == "azimuth" and high - low >= 360 else min(max(share, 0.0), 1.0)
            values[name] = _height(within, low, high) if name == "elevation" else float(low + within * (high - low))
        return LightPlace(**values)


def _height(share: float, low: float, high: float) -> float:
    """The elevation, degrees, below which ``share`` of the sky between two others lies."""
    bottom, top = np.sin(np.radians([low, high]))
    return float(np.clip(np.degrees(np.arcsin(bottom + share * (top - bottom))), low, high))


@dataclass(frozen=True)
class LightTrial:
    """What the target showed with the light at a place, means over the asked views.

    won: the chance of being fooled (``chances``), which is what is maximised. loss: the goal's. fooled: the share.
    """

    place: LightPlace
    won: float
    loss: float
    fooled: float


@dataclass(frozen=True)
class FoundLight:
    """The best place, everything that was tried (in order), and what that took.

    asked: the views, by number, that were looked at: what is reported on them has been searched on, what is reported on
    the others has not.
    """

    place: LightPlace
    trials: tuple[LightTrial, ...]
    asked: tuple[int, ...]

    @property
    def step(self) -> int:
        """Places that were tried."""
        return len(self.trials)

    @property
    def renders(self) -> int:
        """Images that the target was asked for."""
        return len(self.trials) * len(self.asked)


def find_light(
    ask: Ask,
    views: Sequence[View],
    classifier: Classifier | Sequence[Classifier],
    *,
    goal: Goal,
    ranges: LightRanges,
    n_views: int = 12,
    places: int = PLACES,
    seed: int = 0,
    tried: Sequence[LightTrial] = (),
    until: int | None = None,
    on_trial: Callable[[LightTrial], None] = lambda _: None,
) -> FoundLight:
    """The place of the light that fools most (``LightTrial.won``) over ``n_views`` of ``views``, drawn by ``seed``.

    Classifiers give scores alone; of several the mean counts, and a view is fooled when all of them are.
    Asks for ``places * n_views`` images. The same seed and the same images give the same light, in one go or in
    several: ``tried`` are the trials of a search that went ``until`` so many of its places, to go on with.
    Raises ``SpecError`` for no views or classifiers, or a goal that does not fit one.
    """
    members = tuple(classifier) if isinstance(classifier, Sequence) else (classifier,)
    if not views or not members or n_views < 1 or places < 1:
        raise SpecError("A search for a light needs a view, a classifier and a place to try, one of each at least.")
    for member in members:
        goal.check(member.n_classes)
    random = np.random.default_rng(seed)
    asked = tuple(sorted(random.choice(len(views), min(n_views, len(views)), replace=False).tolist()))
    chosen, trials = [views[k] for k in asked], list(tried)
    for place in islice(_to_try(ranges, trials, places, random), len(tried), places if until is None else until):
        trials.append(LightTrial(place, *_judged(ask(place.light_up(chosen)), members, goal)))
        on_trial(trials[-1])
    return FoundLight(_best(trials).place, tuple(trials), asked)


def _best(trials: Sequence[LightTrial]) -> LightTrial:
    return max(trials, key=lambda trial: trial.won)


def _to_try(
    ranges: LightRanges, trials: Sequence[LightTrial], places: int, random: np.random.Generator
) -> Iterator[LightPlace]:
    """At least so many places, in order; ``trials`` grows by what was seen at each before the next is asked for."""
    sweep = max(places - NARROWER * AROUND, -(-places // 2))
    shares: list[NDArray[np.float64]] = []
    centre = np.full(len(ranges.given), 0.5)
    for turn in range(NARROWER + 1):
        if turn:
            won = [trial.won for trial in trials[: len(shares)]]
            centre = shares[won.index(max(won))]
        for share in _around(centre, AROUND if turn else sweep, 2.0**-turn, random):
            shares.append(share)
            yield ranges.place(share)


def save_light(found: FoundLight) -> bytes:
    """What was found so far as the bytes of an .npz file; exact."""
    places = [[np.nan if value is None else value for value in vars(trial.place).values()] for trial in found.trials]
    verdicts = [(trial.won, trial.loss, trial.fooled) for trial in found.trials]
    return pack_arrays({"places": np.array(places), "verdicts": np.array(verdicts), "asked": np.array(found.asked)})


def load_light(data: bytes) -> FoundLight:
    """What ``save_light`` made bytes of. Raises ``ValueError`` or ``OSError`` where they are damaged."""
    arrays = unpack_arrays(data)
    if set(arrays) != {"places", "verdicts", "asked"}:
        raise ValueError(f"These arrays are no search for a light: {sorted(arrays)}.")
    places = [
        LightPlace(azimuth, elevation, *(None if np.isnan(value) else value for value in more))
        for azimuth, elevation, *more in arrays["places"].tolist()
    ]
    trials = [LightTrial(place, *row) for place, row in zip(places, arrays["verdicts"].tolist(), strict=True)]
    return FoundLight(_best(trials).place, tuple(trials), tuple(arrays["asked"].tolist()))


def _around(centre: NDArray[np.float64], count: int, width: float, random: np.random.Generator) -> NDArray[np.float64]:
    """``count`` points (count, dimensions) that fill a box of ``width`` evenly: Roberts's sequence, shifted."""
    dimensions = len(centre)
    root = 2.0
    for _ in range(32):
        root = (1 + root) ** (1 / (dimensions + 1))
    steps = np.arange(count)[:, None] * root ** -np.arange(1.0, dimensions + 1)
    inside = (steps + random.uniform(size=dimensions)) % 1.0
    return np.asarray(centre + width * (inside - 0.5))


def _judged(images: Image8, members: Sequence[Classifier], goal: Goal) -> tuple[float, float, float]:
    """(won, loss, fooled) as of ``LightTrial``."""
    logits = [torch.from_numpy(member.predict(images)) for member in members]
    won = torch.stack([chances(goal, each).mean() for each in logits]).mean()
    loss = torch.stack([goal.losses(each).mean() for each in logits]).mean()
    reached = torch.stack([goal.reached(each) for each in logits]).all(0)
    return float(won), float(loss), float(reached.float().mean())
