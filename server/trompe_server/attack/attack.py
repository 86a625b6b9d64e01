"""Projected gradient ascent on the texture, over many views: the paper's algorithm, on one screen.

Needs no server. With an object, views of it and a classifier with gradients:

    geometry = prepare_geometry(obj, views, size=classifier.image_size, sampling=SamplingModel())
    surrogate = diffuse_surrogate(geometry, views)  # or measured on a target: surrogate.calibration
    textures, budget = textures_of(obj), Budget(epsilon=0.05, alpha=0.01)
    state = attack(start(textures), textures, surrogate, classifier, goal=Goal(label), budget=budget, steps=20)
    painted = budget.repaint(obj, state.deltas)
    Path("mug-adversarial.zip").write_bytes(painted.to_zip())

docs/library.md has the whole example, with a target renderer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

from jaxtyping import Bool
from torch import Tensor

from trompe_server.attack.backgrounds import Backgrounds
from trompe_server.attack.budget import Box, Budget
from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import Objective, Textures, members_of
from trompe_server.attack.optimiser import Iterate
from trompe_server.attack.perception import perceptual_bounds
from trompe_server.attack.search import Search, finished
from trompe_server.attack.state import AttackState
from trompe_server.attack.texels import TexelMasks, movable, moving_blocks
from trompe_server.attack.view_budget import ViewBudget
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.image_pipelines import ImagePipeline
from trompe_server.surrogate import AnySurrogate
from trompe_server.surrogate.blocks import halvings, means, whole
from trompe_shared.api import OptimiserName
from trompe_shared.errors import SpecError


@dataclass(frozen=True)
class Step:
    """Figures of one step at the point of its gradient.

    loss: mean over its views. fooled: share of them on which every classifier is fooled in the surrogate. evaluations:
    images shown to each classifier so far. least_left: further steps if all views are safely won from now on. A safely
    won view is skipped for some steps and counts as won.
    """

    step: int
    loss: float
    fooled: float
    evaluations: int
    least_left: int


def attack(
    state: AttackState,
    textures: Textures,
    surrogate: AnySurrogate,
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier],
    *,
    goal: Goal,
    budget: Budget,
    steps: int,
    total_steps: int | None = None,
    optimiser: OptimiserName = "nesterov",
    masks: Bool[Tensor, "views H W"] | None = None,
    texels: TexelMasks | None = None,
    views_per_step: int | None = None,
    backgrounds: Backgrounds | None = None,
    pipeline: ImagePipeline | None = None,
    seed: int = 0,
    on_step: Callable[[Step], None] = lambda _: None,
) -> AttackState:
    """Take ``steps`` of the ``total_steps`` (default: up to the end of this call) of a search for the change with the
    highest expected loss over the surrogate's views (the paper's equation 3, over many views).

    ``textures`` are sRGB in [0, 1]. With several classifiers the loss is their mean, and a view is fooled when all of
    them are. The search ends early once all views are safely won, or once steps that all look at the same images gain
    nothing more. ``masks`` (saliency) pass only the gradients of their pixels, and only ``texels`` (default:
    ``movable``) move. Each step looks at all views, or at ``views_per_step`` drawn from ``seed`` and the step's number,
    in front of ``backgrounds`` drawn likewise (default: their own); each image passes ``pipeline``, drawn anew. After
    the last step the budget's bound on the images holds for the textures that ``Budget.repaint`` saves.

    Deterministic, in one call or in several. Computes on the surrogate's device. Raises ``SpecError`` for contradictory
    options, before any work.
    """
    device = surrogate.device
    state, textures = state.to(device), {name: texture.to(device) for name, texture in textures.items()}
    masks = masks if masks is None else masks.to(device)
    total = state.step + steps if total_steps is None else total_steps
    if state.step + steps > total:
        raise SpecError(f"Steps up to {state.step + steps} were asked for, but total_steps is {total}.")
    if optimiser not in get_args(OptimiserName):
        raise SpecError(f"Unknown optimiser {optimiser!r}; choose one of {', '.join(get_args(OptimiserName))}.")
    members = members_of(classifier, goal)
    wanted = movable(surrogate, budget, masks) if texels is None else texels
    state, moving = _in_blocks(state, {name: mask.to(device) for name, mask in wanted.items()}, surrogate, budget)
    touched = {name: mask | state.deltas[name].any(2) for name, mask in moving.items()}
    objective = Objective(textures, surrogate, members, goal, masks, surrogate.canvas(textures, touched))
    search = Search(
        objective,
        total,
        seed,
        optimiser,
        box=_box(objective, state.deltas, budget),
        movable=objective.join(moving)[:, None].float().expand(-1, 3).contiguous(),  # booleans take seven times as long
        view_budget=ViewBudget.of(objective, budget.epsilon_view) if budget.epsilon_view is not None else None,
        views_per_step=views_per_step,
        backgrounds=backgrounds,
        pipeline=pipeline,
    )
    momentum = objective.join(state.momentum) if state.momentum else None
    point = Iterate(objective.join(state.deltas), state.memory, momentum)
    for step in range(state.step, state.step + steps):
        if finished(point.memory, goal):
            break
        found, point = search.evaluate(point, step)
        point = search.move(point, found, step)
        on_step(Step(step, found.loss, found.fooled, search.shown(point), search.least_left(point, step)))
    ended = state.step + steps == total or finished(point.memory, goal)
    delta = search.saved(point.delta) if ended else point.delta
    momenta = {} if point.momentum is None else objective.split(point.momentum)
    return AttackState(state.step + steps, objective.split(delta), point.memory, momenta)


def _in_blocks(
    state: AttackState, texels: TexelMasks, surrogate: AnySurrogate, budget: Budget
) -> tuple[AttackState, TexelMasks]:
    """State and moving ``texels`` by block. The first step decides on the blocks; a bound on the images, which holds
    for each saved texel, leaves the texels alone."""
    if state.step:
        counts = {name: halvings(state.deltas[name].shape, mask.shape) for name, mask in texels.items()}
        return state, {name: whole(mask, counts[name]) for name, mask in texels.items()}
    moving = texels if budget.epsilon_view is not None else moving_blocks(texels, surrogate.spare_levels)
    deltas = {name: means(delta, halvings(moving[name].shape, delta.shape)) for name, delta in state.deltas.items()}
    return replace(state, deltas=deltas), moving


def _box(objective: Objective, deltas: Textures, budget: Budget) -> Box:
    """The budget's box around all textures, as one."""
    surrogate = objective.surrogate
    influence = surrogate.influence() if budget.perceptual else {}
    low, high, bounds, weights = {}, {}, {}, {}
    for name, texture in objective.textures.items():
        size, bound = deltas[name].shape[:2], None
        count = halvings(size, texture.shape)
        if budget.perceptual:
            footprint = surrogate.footprint[name]
            bound = bounds[name] = perceptual_bounds(texture, size, footprint=footprint, epsilon=budget.epsilon)
            weights[name] = means(influence[name][..., None], count) * 4**count
        box = budget.box(texture, count, bound=bound)
        low[name], high[name] = box.low, box.high
    whole = Box(budget, objective.join(low), objective.join(high))
    return replace(whole, bound=objective.join(bounds), weight=objective.join(weights)) if budget.perceptual else whole
