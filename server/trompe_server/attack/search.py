"""One run of the attack: the views of each step, the safe margin, and the end of the search.

The margin that counts as safely won starts at the goal's. It is small by default, so that the gradient comes from the
views still to be won. It rises with each step that finds nearly all of its views fooled, because a larger margin also
wins unseen views, and falls with each other step. The search ends when it reaches its maximum, or when steps that look
at the same images gain nothing more (``schedule``).

Saliency masks can lead the search downhill, because masked-out pixels see the same texels. A masked search ends at the
best of its last point, the unpainted textures and, if all steps look at the same images, what they looked at.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.attack.backgrounds import Backgrounds
from trompe_server.attack.budget import Box
from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import Evaluation, Flat, Objective
from trompe_server.attack.optimiser import Iterate, gradient_at, moved
from trompe_server.attack.schedule import Memory, after_step, anew, by_gain, in_rounds, reach, stalled
from trompe_server.attack.view_budget import ViewBudget
from trompe_server.image_pipelines import Drawn, ImagePipeline
from trompe_shared.api import OptimiserName

SKIPPED: Final = 2
"""Steps for which a settled view is skipped."""

RISE: Final = 1.15
"""Factor by which the safe margin rises in a step."""

NEARLY_ALL: Final = 0.99
"""Share of a step's views that must be fooled for the safe margin to rise."""

SAFE_ENOUGH: Final = 6.0
"""The safe margin at which the search ends. A goal with a larger one always runs all steps."""

MOSTLY: Final = 0.5
"""Share of settled images from which logits come before gradients: they take about 0.4 of the time of both."""

AGAIN: Final = 2
"""Least number of steps after views were added."""

RESUME, SHOWN, SAFE, SETTLED = "search.resume", "search.shown", "search.safe", "search.settled"
"""Memory of the search: step from which each view is evaluated again, images shown so far, safe margin, share of the
last images that were settled."""

BEST, SCORED = "search.best", "search.scored"
"""Memory of a masked search: the best change that it looked at, and its score."""


def finished(memory: Memory, goal: Goal) -> bool:
    """Whether all views are so safely won, or so little is gained, that no step is left to take."""
    return float(memory.get(SAFE, goal.safe)) > SAFE_ENOUGH > goal.safe or stalled(memory)


def went_on(memory: Memory, goal: Goal, *, shown: int, added: int) -> Memory:
    """Memory of a search that has looked at ``shown`` further images and ``added`` views: these ask for more steps."""
    sooner = added and SAFE in memory and goal.safe < SAFE_ENOUGH
    safe = {SAFE: memory[SAFE].clamp(max=SAFE_ENOUGH / RISE**AGAIN)} if sooner else {}
    kept = {key: value for key, value in anew(memory).items() if key not in (BEST, SCORED)} if added else memory
    return {**kept, **safe, SHOWN: memory.get(SHOWN, torch.tensor(0)) + shown}


@dataclass(frozen=True)
class Search:
    """Moves an iterate step by step; see the module's docstring.

    total: steps of the run. seed: draws the views and backgrounds of each step. movable: 1 for texels that may move,
    else 0. view_budget: bound on the change of the images, if any. backgrounds: drawn behind each step's views in place
    of their own, if any. pipeline: what happens to the images, drawn anew in each step.
    """

    objective: Objective
    total: int
    seed: int
    optimiser: OptimiserName
    box: Box
    movable: Float[Tensor, "texels 3"]
    view_budget: ViewBudget | None
    views_per_step: int | None
    backgrounds: Backgrounds | None
    pipeline: ImagePipeline | None

    @property
    def steps_by_gain(self) -> bool:
        """Whether the gain of each step decides on the step size and the end: all steps look at the same images."""
        n_views = self.objective.surrogate.n_views
        drawn = (self.views_per_step or n_views) < n_views or self.backgrounds is not None or self.pipeline is not None
        known = not (drawn or self.objective.estimated)
        return self.optimiser == "nesterov" and self.objective.goal.safe < SAFE_ENOUGH and known

    def least_left(self, point: Iterate, step: int) -> int:
        """Number of steps after ``step`` if nearly all views are fooled from now on."""
        goal, most = self.objective.goal, self.total - step - 1
        if goal.loss != "margin" or goal.safe >= SAFE_ENOUGH:
            return most
        return min(most, max(0, math.floor(math.log(SAFE_ENOUGH / self._safe(point), RISE)) + 1))

    def evaluate(self, point: Iterate, step: int) -> tuple[Evaluation, Iterate]:
        """Evaluate the step's views, to which some may have come at the end; returns the iterate with new memory."""
        batches = self.objective.surrogate.batches
        from_start = torch.zeros(sum(map(len, batches)), dtype=torch.long, device=point.delta.device)
        known = point.memory.get(RESUME, from_start)
        resume = torch.cat([known, from_start[len(known) :]])
        change = gradient_at(self.optimiser, point, self._factor(point, step), self.box)
        drawn = self._drawn(batches, step)
        found = self._objective_at(point, step).evaluate(change, drawn, resume <= step)
        memory = {
            RESUME: resume.index_fill(0, found.settled, step + 1 + SKIPPED),
            SHOWN: torch.tensor(self.shown(point) + found.images),
            SAFE: torch.tensor(self._safe_after(found, point)),
        }
        if found.images:
            memory[SETTLED] = torch.tensor(len(found.settled) / found.images)
        score = found.fooled, found.loss
        better = SCORED not in point.memory or score > tuple(point.memory[SCORED].tolist())
        if self.objective.masks is not None and self.steps_by_gain and better:
            memory |= {BEST: change, SCORED: torch.tensor(score, dtype=torch.float64)}
        return found, replace(point, memory={**point.memory, **memory})

    def _drawn(self, batches: Sequence[range], step: int) -> Sequence[int]:
        """Indices of a step's batches: all, or as many as hold about ``views_per_step`` views."""
        total, n_views, views = len(batches), sum(map(len, batches)), self.views_per_step
        if views is None or views >= n_views:
            return range(total)
        count = max(1, round(views * total / n_views))
        return sorted(np.random.default_rng([self.seed, step]).choice(total, count, replace=False).tolist())

    def _safe(self, point: Iterate) -> float:
        return float(point.memory.get(SAFE, self.objective.goal.safe))

    def _safe_after(self, found: Evaluation, point: Iterate) -> float:
        """The next safe margin. Constant for other losses, and for a goal whose margin exceeds the maximum."""
        goal, safe = self.objective.goal, self._safe(point)
        if goal.loss != "margin" or goal.safe > SAFE_ENOUGH:
            return goal.safe
        return safe * RISE if found.fooled >= NEARLY_ALL else max(goal.safe, safe / RISE)

    def _objective_at(self, point: Iterate, step: int) -> Objective:
        """The objective with the safe margin, the backgrounds and the image pipeline of a step."""
        near = reach(point.memory) if self.steps_by_gain and self.objective.masks is None else math.inf
        goal, surrogate = replace(self.objective.goal, safe=self._safe(point), reach=near), self.objective.surrogate
        if self.backgrounds is not None:
            surrogate = self.backgrounds.behind(surrogate, seed=self.seed, step=step)
        drawn = None if self.pipeline is None else Drawn(self.pipeline, self.seed, step)
        settling = float(point.memory.get(SETTLED, 0)) > MOSTLY
        return replace(self.objective, goal=goal, surrogate=surrogate, pipeline=drawn, settling=settling)

    def shown(self, point: Iterate) -> int:
        """Images shown to each classifier so far."""
        return int(point.memory.get(SHOWN, 0))

    def move(self, point: Iterate, found: Evaluation, step: int) -> Iterate:
        """The iterate after ``step``; the same one for a zero gradient."""
        gradient = found.gradient.mul_(self.movable)
        if len(gradient) and any(gradient.aminmax()):  # gradient.any() would take four times as long
            point = moved(self.optimiser, point, gradient, self._factor(point, step), self.box)
            if self.view_budget is not None:
                point = replace(point, delta=self.view_budget.project(point.delta))
        if self.steps_by_gain:
            point = replace(point, memory=after_step(point.memory, found.fooled, found.loss))
        last = step + 1 == self.total or stalled(point.memory)
        return self._best(point) if last and self.objective.masks is not None else point

    def _factor(self, point: Iterate, step: int) -> float:
        return by_gain(point.memory, step, self.total) if self.steps_by_gain else in_rounds(step, self.total)

    def saved(self, delta: Flat) -> Flat:
        """``delta``, or the part of it that keeps the images within their bound once saved in 8 bits."""
        return delta if self.view_budget is None else self.view_budget.saved(delta, levels=self.box.budget.levels)

    def _best(self, point: Iterate) -> Iterate:
        """The iterate, the best change that a step looked at, or no change: what fools most views."""
        changes = [point.delta, torch.zeros_like(point.delta)]
        if BEST in point.memory:
            best = point.memory[BEST]
            changes.append(best if self.view_budget is None else self.view_budget.project(best))
        shown = self.shown(point) + len(changes) * self.objective.surrogate.n_views
        best = max(changes, key=self.objective.score)
        return replace(point, delta=best, memory={**point.memory, SHOWN: torch.tensor(shown)})
