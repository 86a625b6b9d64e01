"""Choice of the few texels to change, by short trial attacks.

The gradient at the unpainted object ranks texels by the gain of a first small step, summed over all views. But the
first texels already win some views, and the sum hides the texels that other views need. So a short attack on the best
few shows which views it does not win, and the gradient of those views is added to the ranking. This is done twice.
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
from trompe_server.attack.objective import Objective, Textures, members_of
from trompe_server.attack.search import SHOWN
from trompe_server.attack.state import start
from trompe_server.attack.texels import TexelMasks, backproject, best_texels, movable
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.image_pipelines import ImagePipeline
from trompe_server.surrogate import AnySurrogate
from trompe_server.surrogate.blocks import repeated

ROUNDS: Final = 2
"""Trial attacks."""

STEPS: Final = 4
"""Steps of each; together they use up the budget."""

Gradient = Mapping[str, Float[Tensor, "H W 3"]]


@dataclass(frozen=True)
class FewTexels:
    """The chosen texels (``masks``), and the number of images that the trials showed to each classifier."""

    masks: TexelMasks
    evaluations: int


def few_texels(
    keep: float,
    textures: Textures,
    surrogate: AnySurrogate,
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier],
    gradients: Float[Tensor, "views H W 3"],
    *,
    goal: Goal,
    budget: Budget,
    within: Sequence[TexelMasks] = (),
    masks: Bool[Tensor, "views H W"] | None = None,
    views_per_step: int | None = None,
    backgrounds: Backgrounds | None = None,
    pipeline: ImagePipeline | None = None,
    seed: int = 0,
    on_step: Callable[[Step], None] = lambda _: None,
) -> FewTexels:
    """The share ``keep``, in (0, 1], of all texels with the most effect, chosen from texels ``within`` all masks.

    ``gradients``: ``image_gradients`` of the target's images of the unpainted object. Other arguments as for
    ``attack``; ``on_step`` reports the trials' steps. Deterministic. Raises ``SpecError`` if ``keep`` is out of range
    or leaves no texel.
    """
    textures = {name: texture.to(surrogate.device) for name, texture in textures.items()}
    canvas = surrogate.canvas(textures, {name: texture[..., 0] >= 0 for name, texture in textures.items()})
    objective = Objective(textures, surrogate, members_of(classifier, goal), goal, masks, canvas)
    if masks is not None:
        gradients = gradients * masks[..., None].to(gradients)
    every_view = torch.ones(surrogate.n_views, dtype=torch.bool, device=surrogate.device)
    total, shown = _scaled(backproject(surrogate, textures, gradients)), 0
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
            pipeline=pipeline,
            seed=seed,
            on_step=on_step,
        )
        tables = {name: repeated(tried.deltas[name], texture.shape) for name, texture in textures.items()}
        found = objective.evaluate(objective.join(tables), range(len(surrogate.batches)), every_view)
        gradient = _scaled(objective.split(found.gradient))
        total = {name: total[name] + gradient[name] for name in total}
        shown += int(tried.memory[SHOWN]) + found.images
    return FewTexels(_best(total, keep, within), shown)


def _scaled(gradient: Gradient) -> Gradient:
    """Scaled to an absolute sum of 1, so that all gradients count alike; zero stays zero."""
    total = sum(float(part.abs().sum()) for part in gradient.values())
    return {name: part / max(total, 1e-30) for name, part in gradient.items()}


def _best(total: Gradient, keep: float, within: Sequence[TexelMasks]) -> TexelMasks:
    scores = {name: part.abs().sum(2) for name, part in total.items()}
    for mask in within:
        scores = {name: score * mask[name].to(score) for name, score in scores.items()}
    return best_texels(scores, keep)
