"""Small displacements of an object's surface that fool a classifier: the same ascent as on the texture, in metres.

What is searched is a field over the surface's positions, each in [-epsilon, epsilon]. The object is moved outwards by
that field smoothed: averages of a bounded field keep its bound, and the gradient that comes back through the averages
is as smooth as they are. Images are predicted by ``Relief``; the outline of the object carries no gradient.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack.beyond.chance import chances
from trompe_server.attack.beyond.relief import Relief, Seen
from trompe_server.attack.beyond.shape import Shape, with_vertices
from trompe_server.attack.goal import Goal
from trompe_server.attack.objective import members_of
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

__all__ = ["VertexBudget", "VertexState", "VertexStep", "load_vertices", "move_vertices", "save_vertices"]

MOMENTUM = 0.9
BATCH = 10
"""Views that are shown to the classifiers at once."""


@dataclass(frozen=True)
class VertexBudget:
    """How far the surface may move: ``epsilon`` of the object's radius, in steps of ``alpha`` of that distance.

    smoothing: rounds in which half of each displacement becomes its neighbours' mean. Raises ``SpecError`` beyond
    0 < epsilon <= 0.5, 0 < alpha <= 1, 0 <= smoothing <= 100.
    """

    epsilon: float
    alpha: float = 0.2
    smoothing: int = 3

    def __post_init__(self) -> None:
        if not (0 < self.epsilon <= 0.5 and 0 < self.alpha <= 1 and 0 <= self.smoothing <= 100):
            raise SpecError(
                "A vertex budget needs 0 < epsilon <= 0.5 (share of the radius), 0 < alpha <= 1 (share of epsilon) and "
                f"0 <= smoothing <= 100; got epsilon={self.epsilon}, alpha={self.alpha}, smoothing={self.smoothing}."
            )

    def reach(self, obj: Object3D) -> float:
        """The farthest that a position may move, metres: so little less than allowed that what is saved, in single
        precision, is not beyond it."""
        farthest = obj.radius * (1 + self.epsilon)
        return max(0.0, self.epsilon * obj.radius - 2 * float(np.spacing(np.float32(farthest))))

    def heights(self, obj: Object3D, shape: Shape, shares: Float[Tensor, " positions"]) -> Tensor:
        """How far each position moves outwards, metres, for a field of ``shares`` of the reach, in [-1, 1]."""
        return self.reach(obj) * shape.smoothed(shares, self.smoothing)

    def reshape(self, obj: Object3D, shape: Shape, state: "VertexState") -> Object3D:
        """``obj`` as an attack leaves it."""
        return with_vertices(obj, shape, self.heights(obj, shape, state.shares))


@dataclass(frozen=True)
class VertexState:
    """Where a search stands after ``step`` steps, all of it float64 by position.

    shares: the field, in [-1, 1]. momentum: of its gradient. seen: the field whose visibility is being used.
    """

    step: int
    shares: Float[Tensor, " positions"]
    momentum: Float[Tensor, " positions"]
    seen: Float[Tensor, " positions"]

    @classmethod
    def of(cls, shape: Shape) -> "VertexState":
        """No displacement at all."""
        nothing = torch.zeros(len(shape.positions), dtype=torch.float64)
        return cls(0, nothing, nothing, nothing)


def save_vertices(state: VertexState) -> bytes:
    """A state as the bytes of an .npz file; exact."""
    return pack_arrays({name: np.asarray(value) for name, value in vars(state).items()}, compressed=False)


def load_vertices(data: bytes) -> VertexState:
    """A state from ``save_vertices``'s bytes. Raises ``ValueError`` or ``OSError`` where they are damaged."""
    arrays = unpack_arrays(data)
    if set(arrays) != {"step", "shares", "momentum", "seen"}:
        raise ValueError(f"These arrays are no state of moved vertices: {sorted(arrays)}.")
    step = int(arrays.pop("step"))
    return VertexState(step, **{name: torch.from_numpy(array) for name, array in arrays.items()})


@dataclass(frozen=True)
class VertexStep:
    """What a step saw before it moved, over its views: the mean chance of being fooled (``chances``), which is
    maximised, and the share on which all classifiers are fooled."""

    step: int
    won: float
    fooled: float


def move_vertices(
    state: VertexState,
    relief: Relief,
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier],
    *,
    goal: Goal,
    budget: VertexBudget,
    steps: int,
    total_steps: int | None = None,
    views_per_step: int | None = None,
    look_anew: int = 5,
    seed: int = 0,
    on_step: Callable[[VertexStep], None] = lambda _: None,
) -> VertexState:
    """``steps`` more of ``total_steps`` (by default those that end with this call) along the sign of the accumulated
    gradient, the step falling linearly from 2 alpha to 0.

    Each step looks at all views, or at ``views_per_step`` drawn by ``seed`` and its number; every ``look_anew`` steps
    all are rasterised anew. Deterministic, in one go or in several.
    """
    total = state.step + steps if total_steps is None else total_steps
    if state.step + steps > total or look_anew < 1:
        raise SpecError(f"Steps up to {state.step + steps} of {total}, looking anew every {look_anew}: not possible.")
    search = _Search(relief, members_of(classifier, goal), goal, budget)
    for step in range(state.step, state.step + steps):
        seen = state.shares if step % look_anew == 0 else state.seen
        gradient, won, fooled = search.look(state.shares, seen, _drawn(len(relief.views), views_per_step, seed, step))
        on_step(VertexStep(step, won, fooled))
        size = gradient.abs().sum().clamp(min=1e-30)
        momentum = MOMENTUM * state.momentum + gradient / size
        pace = 2 * (total - step - 0.5) / total * budget.alpha
        state = VertexState(step + 1, (state.shares + pace * momentum.sign()).clamp(-1, 1), momentum, seen)
    return state


def _drawn(n_views: int, wanted: int | None, seed: int, step: int) -> list[int]:
    """The views that a step looks at."""
    if wanted is None or wanted >= n_views:
        return list(range(n_views))
    drawn: list[int] = np.random.default_rng([seed, step]).choice(n_views, wanted, replace=False).tolist()
    return sorted(drawn)


@dataclass(frozen=True)
class _Search:
    """Judges a field; keeps what the views see of the field that was rasterised last."""

    relief: Relief
    members: tuple[WhiteBoxClassifier, ...]
    goal: Goal
    budget: VertexBudget
    _rasterised: dict[int, tuple[Tensor, Seen]] = field(default_factory=dict)

    def look(self, shares: Tensor, seen: Tensor, views: Sequence[int]) -> tuple[Tensor, float, float]:
        """(gradient of the summed chance, its mean, share of the views fooled) at ``shares``, with what is visible at
        ``seen``."""
        shape, leaf = self.relief.shape, shares.clone().requires_grad_()
        positions = shape.moved(self._heights(leaf))
        normals = shape.shaded(positions)
        collected = [each.detach().requires_grad_() for each in (positions, normals)]
        total, won = 0.0, 0
        for start in range(0, len(views), BATCH):
            some = views[start : start + BATCH]
            images = torch.stack([self.relief.image(self._visible(seen, view), view, *collected) for view in some])
            logits = [member.logits(images) for member in self.members]
            chance = torch.stack([chances(self.goal, each).sum() for each in logits]).mean()
            chance.backward()  # type: ignore[no-untyped-call]
            total += float(chance.detach())
            won += int(torch.stack([self.goal.reached(each) for each in logits]).all(0).sum())
        pulls = [each.grad if each.grad is not None else torch.zeros_like(each) for each in collected]
        (gradient,) = torch.autograd.grad([positions, normals], leaf, pulls)
        return gradient.nan_to_num(0, 0, 0), total / len(views), won / len(views)

    def _heights(self, shares: Tensor) -> Tensor:
        return self.budget.heights(self.relief.obj, self.relief.shape, shares)

    def _visible(self, seen: Tensor, view: int) -> Seen:
        known = self._rasterised.get(view)
        if known is not None and known[0] is seen:
            return known[1]
        found = self.relief.at(self.relief.shape.moved(self._heights(seen)), view)
        self._rasterised[view] = (seen, found)
        return found
