"""Projected gradient ascent on the texture, over many views: the paper's algorithm, on one screen.

It needs no server. With an object, views of it and a classifier that gives gradients:

    geometry = prepare_geometry(obj, views, size=classifier.image_size, sampling=SamplingModel())
    surrogate = diffuse_surrogate(geometry, views)  # or one measured on a target renderer: surrogate.calibration
    textures, budget = textures_of(obj), Budget(epsilon=0.05, alpha=0.01)
    state = attack(start(textures), textures, surrogate, classifier, goal=Goal(label), budget=budget, steps=20)
    painted = budget.repaint(obj, state.deltas)
    Path("adversarial.zip").write_bytes(painted.to_zip())

The whole of it, with a target: docs/library.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from trompe_server.attack.backgrounds import Backgrounds
from trompe_server.attack.budget import Budget
from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import Objective, Textures, members_of
from trompe_server.attack.optimiser import Box, Memory, OptimiserName, Point
from trompe_server.attack.search import Schedule, Search
from trompe_server.attack.state import AttackState
from trompe_server.attack.texels import TexelMasks, movable
from trompe_server.attack.view_budget import ViewBudget
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.surrogate import Surrogate

__all__ = ["Step", "attack"]


@dataclass(frozen=True)
class Step:
    """What one step saw where it took its gradient, before it moved.

    loss: mean over its views. fooled: share of them on whose surrogate images every classifier is fooled. evaluations:
    images that each classifier has been shown so far, with those by which runs are compared where one ends. A view that
    was safely won at its last look rests for some steps and counts as won.
    """

    step: int
    loss: float
    fooled: float
    evaluations: int


def attack(
    state: AttackState,
    textures: Textures,
    surrogate: Surrogate,
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier],
    *,
    goal: Goal,
    budget: Budget,
    steps: int,
    total_steps: int | None = None,
    optimiser: OptimiserName = "nesterov",
    restarts: int = 0,
    random_start: bool = False,
    masks: Bool[Tensor, "views H W"] | None = None,
    texels: TexelMasks | None = None,
    views_per_step: int | None = None,
    backgrounds: Backgrounds | None = None,
    seed: int = 0,
    on_step: Callable[[Step], None] = lambda _: None,
) -> AttackState:
    """``steps`` more of the ``total_steps`` (by default those that end with this call) of a search for the change with
    the highest expected loss over the surrogate's views.

    ``textures`` are sRGB in [0, 1]. Of several classifiers the mean loss counts, and a view is fooled when all of them
    are. ``restarts`` further runs from random points share the steps; ``random_start`` begins the first one so too.
    What is left of the steps is left out once all views are won so safely that more would change nothing.
    ``masks`` (saliency) let only those pixels' gradients through, and only ``texels`` (by default those ``movable``)
    move. Each step looks at all views, or at ``views_per_step`` drawn by ``seed`` and its number, in front of some of
    ``backgrounds`` drawn likewise (by default their own). After the last step the budget's bound on the images holds
    for the textures that ``Budget.repaint`` saves. Deterministic, in one go or in several. It computes on the
    surrogate's device, wherever the rest lies. Raises ``SpecError`` for options that contradict each other, before any
    work.
    """
    device = surrogate.geometry.device
    state, textures = state.to(device), {name: texture.to(device) for name, texture in textures.items()}
    masks = masks if masks is None else masks.to(device)
    total = state.step + steps if total_steps is None else total_steps
    schedule = Schedule(total, restarts, random_start, seed)
    schedule.check(optimiser, last=state.step + steps)
    members = members_of(classifier, goal)
    wanted = movable(surrogate, budget, masks) if texels is None else texels
    moving = {name: mask.to(device) for name, mask in wanted.items()}
    touched = {name: mask | state.deltas[name].any(2) for name, mask in moving.items()}
    objective = Objective(textures, surrogate, members, goal, masks, surrogate.canvas(textures, touched))
    search = Search(
        objective,
        schedule,
        optimiser,
        box=Box(budget, objective.source),
        movable=objective.join(moving)[:, None].float().expand(-1, 3).contiguous(),  # booleans take seven times as long
        within=ViewBudget.of(objective, budget.epsilon_view) if budget.epsilon_view is not None else None,
        views_per_step=views_per_step,
        backgrounds=backgrounds,
    )
    point = Point(objective.join(state.deltas), _joined(objective, state.memory))
    for step in range(state.step, state.step + steps):
        if search.over(point):
            break
        look, point = search.look(search.begin(point, step), step)
        point = search.move(point, look, step)
        on_step(Step(step, look.loss, look.fooled, search.shown(point)))
    delta = search.saved(point.delta) if state.step + steps == total else point.delta
    return AttackState(state.step + steps, objective.split(delta), _split(objective, point.memory))


def _joined(objective: Objective, memory: Memory) -> Memory:
    """What is remembered of each texel, of those alone that may move."""
    sizes = [texture.shape[:2] for texture in objective.textures.values()]

    def joined(value: Tensor) -> Tensor:
        if value.ndim != 2:
            return value
        parts = torch.split(value, [height * width for height, width in sizes])
        tables = [part.view(*size, -1) for part, size in zip(parts, sizes, strict=True)]
        return objective.join(dict(zip(objective.textures, tables, strict=True)))

    return {name: joined(value) for name, value in memory.items()}


def _split(objective: Objective, memory: Memory) -> Memory:
    """The reverse of ``_joined``; zero for the texels that may not move."""

    def split(value: Tensor) -> Tensor:
        if value.ndim != 2:
            return value
        return torch.cat([table.flatten(0, 1) for table in objective.split(value).values()])

    return {name: split(value) for name, value in memory.items()}
