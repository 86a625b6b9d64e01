"""The runs of a search: where each begins, how its steps are paced, which of them found the best change.

A run begins at the unpainted textures or at random, and takes its share of the steps. Of several runs, and of a method
that goes back and forth, the change with the highest loss over all of the attack's own views in the surrogate wins;
nothing else is looked at. Through masks runs may lead downhill, for texels behind them are seen by other pixels too:
there no change at all wins where it fools more views.

The margin from which a view counts as safely won is the goal's at first. It is small by default, so that the gradient
is that of the views still to be won. It rises with each step that finds nearly all of its views fooled, for what is won
by more is won on unseen views too, and falls with each that does not. Where it has risen to the top, the search is
over.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.attack.backgrounds import Backgrounds
from trompe_server.attack.objective import Look, Objective
from trompe_server.attack.optimiser import OPTIMISERS, Box, OptimiserName, Pace, Point
from trompe_server.attack.view_budget import ViewBudget
from trompe_shared.errors import SpecError

__all__ = ["Schedule", "Search"]

Flat = Float[Tensor, "texels 3"]

REST: Final = 2
"""Steps for which a view that is settled is not looked at."""

BEGIN: Final = 1
"""Keeps the random numbers of a run's beginning apart from those of a step's views."""

RISE: Final = 1.15
"""Factor by which the safe margin rises with a step."""

NEARLY_ALL: Final = 0.99
"""Share of a step's views that must be fooled for the safe margin to rise."""

SAFE_ENOUGH: Final = 6.0
"""The safe margin at which the search is over. A goal whose own is larger takes all steps, with that."""

WAKES, SHOWN, SAFE = "search.wakes", "search.shown", "search.safe"
BEST, BEST_LOSS = "search.best", "search.best_loss"
"""What the search remembers beside its method: the step at which each view is looked at again, the images shown so far,
the safe margin, the best change of the runs that are over, and its loss."""


@dataclass(frozen=True)
class Schedule:
    """``total`` steps, shared evenly by the first run and ``restarts`` more. Raises ``SpecError`` for too few."""

    total: int
    restarts: int
    random_start: bool
    seed: int

    def __post_init__(self) -> None:
        if self.restarts < 0:
            raise SpecError(f"restarts must be 0 or more, got {self.restarts}.")
        if self.total <= self.restarts:
            raise SpecError(
                f"{self.total} steps are too few for {self.restarts} restarts: each run needs at least one of them."
            )

    def check(self, optimiser: OptimiserName, *, last: int) -> None:
        """Raise ``SpecError`` unless ``optimiser`` is known and can use so many steps, of which there are ``last``."""
        if last > self.total:
            raise SpecError(f"Steps up to {last} were asked for, but total_steps is {self.total}.")
        if optimiser not in OPTIMISERS:
            raise SpecError(f"There is no optimiser {optimiser!r}; choose one of {', '.join(OPTIMISERS)}.")
        runs = self.restarts + 1
        if optimiser == "fgsm" and self.total != runs:
            raise SpecError(f"fgsm is a single step: ask for {runs} (one a run), not {self.total}, or use pgd.")

    def pace(self, step: int) -> tuple[int, Pace]:
        """The run that ``step`` belongs to, and how far that is."""
        bounds = [run * self.total // (self.restarts + 1) for run in range(self.restarts + 2)]
        run = next(run for run, end in enumerate(bounds[1:]) if step < end)
        return run, Pace(step - bounds[run], bounds[run + 1] - bounds[run])

    def drawn(self, batches: Sequence[range], views: int | None, step: int) -> Sequence[int]:
        """The batches that a step looks at: all, or as many as hold about ``views`` views."""
        total, n_views = len(batches), sum(map(len, batches))
        if views is None or views >= n_views:
            return range(total)
        count = max(1, round(views * total / n_views))
        return sorted(np.random.default_rng([self.seed, step]).choice(total, count, replace=False).tolist())


@dataclass(frozen=True)
class Search:
    """Moves a point step by step; see the head of this module.

    movable: 1 for texels that may move, else 0. within: keeps the images' change in bounds, where that is asked for.
    backgrounds: what each step's views are set in front of, where not their own.
    """

    objective: Objective
    schedule: Schedule
    optimiser: OptimiserName
    box: Box
    movable: Float[Tensor, "texels 3"]
    within: ViewBudget | None
    views_per_step: int | None
    backgrounds: Backgrounds | None

    def over(self, point: Point) -> bool:
        """Whether all is won so safely that there is nothing left to do."""
        return self._safe(point) > SAFE_ENOUGH > self.objective.goal.safe

    def begin(self, point: Point, step: int) -> Point:
        """The point that ``step`` starts from: a random one where it is the first of a run that begins so."""
        run, pace = self.schedule.pace(step)
        if pace.done or not (run or self.schedule.random_start):
            return point
        delta = self._at_random(run).to(self.box.texture.device) * self.movable
        kept = {name: value for name, value in _mine(point.memory).items() if name not in {WAKES, SAFE}}
        return Point(self._in_view(self.box.project(delta)), kept)

    def look(self, point: Point, step: int) -> tuple[Look, Point]:
        """What the step sees from ``point``, and the point with that kept in mind."""
        batches = self.objective.surrogate.batches
        nothing = torch.zeros(sum(map(len, batches)), dtype=torch.long, device=point.delta.device)
        wakes = point.memory.get(WAKES, nothing)
        at = OPTIMISERS[self.optimiser].looks_at(point, self.schedule.pace(step)[1], self.box)
        drawn = self.schedule.drawn(batches, self.views_per_step, step)
        look = self._asked(point, step).look(at, drawn, wakes <= step)
        wakes = wakes.index_fill(0, look.settled, step + 1 + REST)
        known = {
            WAKES: wakes,
            SHOWN: torch.tensor(self.shown(point) + look.images),
            SAFE: torch.tensor(self._safe_after(look, point)),
        }
        return look, replace(point, memory={**point.memory, **known})

    def _safe(self, point: Point) -> float:
        return float(point.memory.get(SAFE, self.objective.goal.safe))

    def _safe_after(self, look: Look, point: Point) -> float:
        """The safe margin after a look; other losses have none, and one out of reach from the start stays there."""
        goal, safe = self.objective.goal, self._safe(point)
        if goal.loss != "margin" or goal.safe > SAFE_ENOUGH or OPTIMISERS[self.optimiser].compares:
            return goal.safe
        return safe * RISE if look.fooled >= NEARLY_ALL else max(goal.safe, safe / RISE)

    def _asked(self, point: Point, step: int) -> Objective:
        """The objective with the safe margin, and the backgrounds, of a step."""
        goal, surrogate = replace(self.objective.goal, safe=self._safe(point)), self.objective.surrogate
        if self.backgrounds is not None:
            surrogate = self.backgrounds.behind(surrogate, seed=self.schedule.seed, step=step)
        return replace(self.objective, goal=goal, surrogate=surrogate)

    def shown(self, point: Point) -> int:
        """Images that each classifier has been shown so far."""
        return int(point.memory.get(SHOWN, 0))

    def move(self, point: Point, look: Look, step: int) -> Point:
        """The point after ``step``. Where nothing pulls, the same one; at the end of all runs, the best one."""
        _, pace = self.schedule.pace(step)
        pull = look.gradient.mul_(self.movable)
        if len(pull) and any(pull.aminmax()):  # pull.any() would take four times as long
            mine, its = _mine(point.memory), _its(point.memory)
            moved = OPTIMISERS[self.optimiser].step(Point(point.delta, its), pull, look.loss, pace, self.box)
            point = Point(self._in_view(moved.delta), {**mine, **moved.memory})
        if pace.done + 1 < pace.length:
            return point
        point = self._ended(point, step)
        masked = self.objective.masks is not None
        return self._no_worse(point) if masked and step + 1 == self.schedule.total else point

    def saved(self, delta: Flat) -> Flat:
        """``delta``, or what of it keeps the images within their bound once it is saved in 8 bits."""
        return delta if self.within is None else self.within.saved(delta, levels=self.box.budget.levels)

    def _in_view(self, delta: Flat) -> Flat:
        return delta if self.within is None else self.within.project(delta)

    def _at_random(self, run: int) -> Flat:
        """Uniform in the budget, zero-mean, the same for the same seed and run."""
        epsilon = self.box.budget.epsilon
        number = int(np.random.SeedSequence([self.schedule.seed, run, BEGIN]).generate_state(1)[0])
        generator = torch.Generator().manual_seed(number)
        return torch.empty(self.box.texture.shape).uniform_(-epsilon, epsilon, generator=generator)

    def _ended(self, point: Point, step: int) -> Point:
        """A run is over: keep the better of what it found and what was found before."""
        found = [point.delta, point.memory["best"]] if "best" in point.memory else [point.delta]
        if len(found) == 1 and not self.schedule.restarts:
            return point
        losses = [self.objective.standing(delta).loss for delta in found]
        shown = self.shown(point) + len(losses) * self.objective.surrogate.n_views
        if BEST in point.memory:
            found, losses = [point.memory[BEST], *found], [float(point.memory[BEST_LOSS]), *losses]
        loss, best = max(zip(losses, found, strict=True), key=lambda pair: pair[0])
        told = {BEST: best, BEST_LOSS: torch.tensor(loss, dtype=torch.float64), SHOWN: torch.tensor(shown)}
        kept = {**_mine(point.memory), **told}
        return Point(best, kept) if step + 1 == self.schedule.total else Point(point.delta, kept)

    def _no_worse(self, point: Point) -> Point:
        """The point, or no change at all where that fools more views."""
        nothing = torch.zeros_like(point.delta)
        best = max(point.delta, nothing, key=self.objective.standing)
        shown = self.shown(point) + 2 * self.objective.surrogate.n_views
        return Point(best, {**point.memory, SHOWN: torch.tensor(shown)})


def _mine(memory: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What the search remembers."""
    return {name: value for name, value in memory.items() if name.startswith("search.")}


def _its(memory: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What the method remembers."""
    return {name: value for name, value in memory.items() if not name.startswith("search.")}
