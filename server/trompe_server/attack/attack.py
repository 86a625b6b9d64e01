"""Projected gradient ascent on the texture, over many views: the paper's algorithm, on one screen.

state = start(textures)
budget = Budget(epsilon=0.05, alpha=0.01)
state = attack(state, textures, surrogate, classifier, label, budget=budget, steps=20)
painted = {name: budget.quantise(delta, ...) for name, delta in state.deltas.items()}
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack.budget import Budget
from trompe_server.attack.goal import fooled, margin_loss
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.surrogate import Surrogate

__all__ = ["AttackState", "Step", "attack", "load_state", "movable", "save_state", "start"]

MOMENTUM = 0.9

Textures = Mapping[str, Float[Tensor, "H W 3"]]


@dataclass(frozen=True)
class AttackState:
    """All that a step starts from: the change of each texture after ``step`` steps (sRGB in [0, 1] units), and the
    running mean of its gradients, each of norm 1."""

    step: int
    deltas: Textures
    momenta: Textures


@dataclass(frozen=True)
class Step:
    """What one step saw, before it moved: mean loss, and the share of views the surrogate's images fool the classifier
    on."""

    step: int
    loss: float
    fooled: float


def start(textures: Textures) -> AttackState:
    """No change at all."""
    nothing = {name: torch.zeros_like(texture) for name, texture in textures.items()}
    return AttackState(0, nothing, nothing)


def movable(
    surrogate: Surrogate, budget: Budget, masks: Bool[Tensor, "views H W"] | None = None
) -> Mapping[str, Bool[Tensor, "H W"]]:
    """The texels worth moving: those whose whole budget changes the attack's pixels by half an 8-bit level or more in
    total.

    Coarse mip levels let a pixel at a grazing angle read a little of every texel. Without this rule a sign step would
    move them all at full size for an effect nobody can see.
    """
    least = 0.5 / 255 / budget.epsilon
    return {name: weight >= least for name, weight in surrogate.influence(masks).items()}


def attack(
    state: AttackState,
    textures: Textures,
    surrogate: Surrogate,
    classifier: WhiteBoxClassifier,
    label: int,
    *,
    budget: Budget,
    steps: int,
    total_steps: int | None = None,
    masks: Bool[Tensor, "views H W"] | None = None,
    texels: Mapping[str, Bool[Tensor, "H W"]] | None = None,
    views_per_step: int | None = None,
    seed: int = 0,
    on_step: Callable[[Step], None] = lambda _: None,
) -> AttackState:
    """``steps`` more steps of projected sign-gradient ascent on the expected margin over the surrogate's views.

    Momentum as Dong et al. (2018); the step falls linearly from ``2 alpha`` to 0 over ``total_steps`` (by default those
    that end with this call), so that ``alpha`` is its mean. ``textures`` are sRGB in [0, 1]; ``masks`` (saliency) let
    only those pixels' gradients through, and only ``texels`` (by default those ``movable``) move. Each step looks at
    all views, or at ``views_per_step`` drawn by ``seed`` and the step's number. Deterministic.
    """
    total = state.step + steps if total_steps is None else total_steps
    allowed = movable(surrogate, budget, masks) if texels is None else texels
    for step in range(state.step, state.step + steps):
        batches = _drawn(surrogate, views_per_step, seed, step)
        gradients, seen = _gradients(state.deltas, textures, surrogate, batches, classifier, label, masks)
        on_step(Step(step, *seen))
        momenta = _accumulated(state.momenta, {name: gradients[name] * allowed[name][..., None] for name in gradients})
        scale = 2 * (total - step - 0.5) / total
        moved = {
            name: budget.ascend(delta, momenta[name], textures[name], scale=scale)
            for name, delta in state.deltas.items()
        }
        state = AttackState(step + 1, moved, momenta)
    return state


def _drawn(surrogate: Surrogate, views: int | None, seed: int, step: int) -> Sequence[int]:
    """Batches of the surrogate that a step looks at: all, or as many as hold about ``views`` views."""
    total = len(surrogate.batches)
    if views is None or views >= surrogate.n_views:
        return range(total)
    count = max(1, round(views * total / surrogate.n_views))
    drawn = np.random.default_rng([seed, step]).choice(total, count, replace=False)
    return sorted(drawn.tolist())


def _accumulated(momenta: Textures, gradients: Textures) -> Textures:
    """The running mean of the gradients with one more, scaled to an L1 norm of 1 over all textures."""
    norm = sum(float(torch.linalg.vector_norm(gradient, ord=1)) for gradient in gradients.values())
    return {
        name: (MOMENTUM * momenta[name]).add_(gradient, alpha=1 / max(norm, 1e-30))
        for name, gradient in gradients.items()
    }


def _gradients(
    deltas: Textures,
    textures: Textures,
    surrogate: Surrogate,
    batches: Sequence[int],
    classifier: WhiteBoxClassifier,
    label: int,
    masks: Bool[Tensor, "views H W"] | None,
) -> tuple[Textures, tuple[float, float]]:
    """Gradient of the summed loss by each texture, and (mean loss, share of fooled views)."""
    leaves = {name: (textures[name] + delta).requires_grad_() for name, delta in deltas.items()}
    texels = surrogate.texels(leaves)
    collected = texels.detach().requires_grad_()
    loss, won, count = 0.0, 0, sum(len(surrogate.batches[batch]) for batch in batches)
    for batch in batches:
        logits = classifier.logits(surrogate.render(collected, batch, masks=masks))
        total = margin_loss(logits, label).sum()
        total.backward()  # type: ignore[no-untyped-call]
        loss, won = loss + float(total.detach()), won + int(fooled(logits, label).sum())
    gradients = torch.autograd.grad(texels, list(leaves.values()), collected.grad)
    return dict(zip(leaves, gradients, strict=True)), (loss / count, won / count)


def save_state(state: AttackState) -> bytes:
    """A state as the bytes of an .npz file; exact."""
    tables = {_DELTA: state.deltas, _MOMENTUM: state.momenta}
    arrays = {prefix + name: table[name].cpu().numpy() for prefix, table in tables.items() for name in table}
    return pack_arrays({"step": np.array(state.step)} | arrays, compressed=False)


def load_state(data: bytes) -> AttackState:
    """A state from ``save_state``'s bytes. Raises ``ValueError`` or ``OSError`` where they are damaged."""
    arrays = unpack_arrays(data)
    if "step" not in arrays:
        raise ValueError(f"These arrays are no attack state: there is no 'step' among {sorted(arrays)}.")

    def table(prefix: str) -> Textures:
        names = [name for name in arrays if name.startswith(prefix)]
        return {name.removeprefix(prefix): torch.from_numpy(arrays[name]) for name in names}

    return AttackState(int(arrays["step"]), table(_DELTA), table(_MOMENTUM))


_DELTA = "delta:"
_MOMENTUM = "momentum:"
