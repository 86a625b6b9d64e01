"""What the attack maximises, and when it has been reached."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from trompe_server.checks import check_goal
from trompe_server.classifiers.protocol import finite
from trompe_shared.errors import SpecError

__all__ = ["SAFE_MARGIN", "Goal", "Loss"]

Loss = Literal["margin", "cross_entropy", "dlr"]

SAFE_MARGIN: Final = 1.0
"""A view whose margin is this large is safely won: the margin loss spends no more gradient on it."""

EQUAL: Final = 1e-3
"""Logits that differ by less are equal to the DLR loss, which divides by a difference of logits."""

Logits = Float[Tensor, "views classes"]
PerView = Float[Tensor, " views"]


@dataclass(frozen=True)
class Goal:
    """Away from ``label``, or towards ``target`` where one is given.

    ``top_k``: the true class must leave the k best ones (1: it must not be the best). ``loss`` is maximised:
    ``margin`` (Carlini and Wagner 2017, clamped once a view is safely won), ``cross_entropy``, or ``dlr`` (the
    difference of logits ratio of Croce and Hein 2020, which no scaling of the logits changes). ``safe`` is the margin
    from which a view is safely won.

    Raises ``SpecError`` for options that contradict each other; ``check`` does for what depends on the classifier.
    """

    label: int
    target: int | None = None
    top_k: int = 1
    loss: Loss = "margin"
    safe: float = SAFE_MARGIN

    def __post_init__(self) -> None:
        if self.loss not in get_args(Loss):
            raise SpecError(f"There is no loss {self.loss!r}; choose one of {', '.join(get_args(Loss))}.")
        if self.top_k < 1:
            raise SpecError(f"top_k must be at least 1, got {self.top_k}.")
        if self.target == self.label:
            raise SpecError(
                f"The target class {self.target} is the object's own class: choose another one, or no target "
                "to have the object taken for anything else."
            )
        if self.target is not None and self.top_k > 1:
            raise SpecError(
                f"top_k={self.top_k} is about leaving the best classes, target={self.target} about becoming the best "
                "one: choose one of the two."
            )

    def check(self, n_classes: int) -> None:
        """Raise ``SpecError`` when a classifier of ``n_classes`` classes cannot have this goal."""
        for name, index in (("label", self.label), ("target class", self.target)):
            if index is not None and not 0 <= index < n_classes:
                raise SpecError(f"The {name} {index} is none of the classifier's {n_classes} classes (0..n-1).")
        check_goal(self.loss, n_classes, top_k=self.top_k, targeted=self.target is not None)

    def reached(self, logits: Logits) -> Bool[Tensor, " views"]:
        """Where the classifier is fooled: it says ``target``, or ``label`` is not among its ``top_k`` best."""
        logits = finite(logits)
        if self.target is not None:
            return logits.argmax(1) == self.target
        if self.top_k == 1:
            return logits.argmax(1) != self.label
        return (logits > logits[:, self.label, None]).sum(1) >= self.top_k

    def margins(self, logits: Logits) -> PerView:
        """By how much a view is won: positive where the goal is reached, negative where not, finite everywhere.

        The k-th best other logit minus the true one, or the target's minus the best other one.
        """
        return self._margins(finite(logits))

    def losses(self, logits: Logits, *, clamped: bool = True) -> PerView:
        """The loss of each view, to be maximised; finite everywhere, and so is its gradient.

        ``clamped=False`` leaves out the margin's clamp, so that a view that is safely won has a gradient too.
        """
        losses = _LOSSES[self.loss](self, finite(logits))
        return losses.clamp(max=self.safe) if clamped and self.loss == "margin" else losses

    def settled(self, logits: Logits) -> Bool[Tensor, " views"]:
        """Views that the loss asks no more of: its gradient is zero there."""
        if self.loss != "margin":
            return torch.zeros(len(logits), dtype=torch.bool, device=logits.device)
        return self.margins(logits) >= self.safe

    def _margins(self, logits: Logits) -> PerView:
        subject = self.label if self.target is None else self.target
        others = logits.clone()
        others[:, subject] = -torch.inf
        rival = others.topk(self.top_k, dim=1).values[:, -1]
        return rival - logits[:, subject] if self.target is None else logits[:, subject] - rival

    def _cross_entropy(self, logits: Logits) -> PerView:
        subject = self.label if self.target is None else self.target
        losses = F.cross_entropy(logits, logits.new_full((len(logits),), subject, dtype=torch.long), reduction="none")
        return losses if self.target is None else -losses

    def _dlr(self, logits: Logits) -> PerView:
        best = logits.topk(self._ranks[-1] + 1, dim=1).values
        scale = best[:, 0] - best[:, list(self._ranks)].mean(1)
        return self._margins(logits) / scale.clamp(min=EQUAL)

    @property
    def _ranks(self) -> tuple[int, ...]:
        """The places, counted from 0, whose distance from the best logit the DLR loss measures in."""
        return (self.top_k + 1,) if self.target is None else (2, 3)


_LOSSES: Final[Mapping[str, Callable[[Goal, Logits], PerView]]] = {
    "margin": Goal._margins,
    "cross_entropy": Goal._cross_entropy,
    "dlr": Goal._dlr,
}
