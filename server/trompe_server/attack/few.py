"""Which few texels to change, found by trying.

The gradient of the unpainted object's images ranks texels by what a first small step gains, summed over all views. But
some views are won by the first texels, and ask no more; others need texels that this sum hides. So a short attack on
the best few shows which views they do not win, and the gradient of those is added to the ranking; that twice.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from trompe_server.attack.attack import Step, attack
from trompe_server.attack.backgrounds import Backgrounds
from trompe_server.attack.budget import Budget
from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import Look, Objective, Textures, members_of
from trompe_server.attack.state import start
from trompe_server.attack.texels import TexelMasks, best_texels, collect, movable
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.surrogate import Surrogate

__all__ = ["FewTexels", "few_texels"]

ROUNDS: Final = 2
"""Short attacks."""

STEPS: Final = 4
"""Steps of each, so long that they use up the budget."""

Pull = Mapping[str, Float[Tensor, "H W 3"]]


@dataclass(frozen=True)
class FewTexels:
    """The texels, as ``masks``, and how many images each classifier was shown by the short attacks that found them."""

    masks: TexelMasks
    evaluations: int


def few_texels(
    keep: float,
    textures: Textures,
    surrogate: Surrogate,
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier],
    gradients: Float[Tensor, "views H W 3"],
    *,
    goal: Goal,
    budget: Budget,
    within: Sequence[TexelMasks] = (),
    masks: Bool[Tensor, "views H W"] | None = None,
    views_per_step: int | None = None,
    backgrounds: Backgrounds | None = None,
    seed: int = 0,
    on_step: Callable[[Step], None] = lambda _: None,
) -> FewTexels:
    """The share ``keep``, in (0, 1], of all texels with which an attack gets furthest, of those ``within`` masks.

    ``gradients``: ``image_gradients`` of the target's images of the unpainted object. All else is as in ``attack``;
    ``on_step`` hears of the short attacks' steps. Deterministic. Raises ``SpecError`` where ``keep`` is out of range or
    leaves no texel.
    """
    objective = Objective(textures, surrogate, members_of(classifier, goal), goal, masks)
    if masks is not None:
        gradients = gradients * masks[..., None].to(gradients)
    total, shown = _scaled(collect(surrogate, textures, gradients)), 0
    taken: list[Step] = []

    def told(step: Step) -> None:
        taken.append(step)
        on_step(step)

    for _ in range(ROUNDS):
        tried = attack(
            *(start(textures), textures, surrogate, classifier),
            goal=goal,
            budget=replace(budget, alpha=budget.epsilon / STEPS),
            steps=STEPS,
            masks=masks,
            texels=movable(surrogate, budget, masks, within=[*within, _best(total, keep, within)]),
            views_per_step=views_per_step,
            backgrounds=backgrounds,
            seed=seed,
            on_step=told,
        )
        look = _look(objective, tried.deltas)
        pull = _scaled(objective.split(look.gradient))
        total = {name: total[name] + pull[name] for name in total}
        shown += taken[-1].evaluations + look.images
    return FewTexels(_best(total, keep, within), shown)


def _look(objective: Objective, deltas: Textures) -> Look:
    """All views at a change, and their gradient by all texels; zero where every view is safely won."""
    surrogate = objective.surrogate
    awake = torch.ones(surrogate.n_views, dtype=torch.bool, device=objective.source.device)
    return objective.look(objective.join(deltas), range(len(surrogate.batches)), awake)


def _scaled(pull: Pull) -> Pull:
    """With a sum of 1, so that each counts alike; zero stays zero."""
    total = sum(float(part.abs().sum()) for part in pull.values())
    return {name: part / max(total, 1e-30) for name, part in pull.items()}


def _best(total: Pull, keep: float, within: Sequence[TexelMasks]) -> TexelMasks:
    scores = {name: part.abs().sum(2) for name, part in total.items()}
    for mask in within:
        scores = {name: score * mask[name].to(score) for name, score in scores.items()}
    return best_texels(scores, keep)
