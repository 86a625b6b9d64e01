"""Goal of the attack: the loss to maximise, and the condition of success."""

import math
import operator
from dataclasses import dataclass
from typing import Final, SupportsIndex, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_server.classifiers.protocol import finite
from trompe_server.spec.checks import check_labels, check_target, check_top_k
from trompe_shared.api import Loss
from trompe_shared.errors import SpecError

SAFE_MARGIN: Final = 1.0
"""Margin from which a view is safely won: the margin loss has no gradient there."""

SLOPE: Final = 0.001
"""Share of the gradient that a hopeless view keeps."""

Logits = Float[Tensor, "views classes"]
PerView = Float[Tensor, " views"]


@dataclass(frozen=True)
class Goal:
    """Away from ``label``, or towards ``target`` if given.

    label: the true class, or several that all count as the object. top_k: no true class may be among the k best (1: the
    best). loss: maximised; ``margin`` (Carlini and Wagner 2017, clamped once a view is safely won) or
    ``cross_entropy``. safe: margin from which a view is safely won. reach: margin from which the loss of a lost view
    flattens, so that hopeless views do not outvote those that can be won. Raises ``SpecError`` for contradictory
    options.
    """

    label: SupportsIndex | tuple[int, ...]
    target: int | None = None
    top_k: int = 1
    loss: Loss = "margin"
    safe: float = SAFE_MARGIN
    reach: float = math.inf

    def __post_init__(self) -> None:
        if self.loss not in get_args(Loss):
            raise SpecError(f"Unknown loss {self.loss!r}; choose one of {', '.join(get_args(Loss))}.")
        if self.top_k < 1:
            raise SpecError(f"`top_k` must be at least 1, got {self.top_k}.")
        check_target(self.labels, self.target)
        if self.target is not None and self.top_k > 1:
            raise SpecError(
                f"`target: {self.target}` makes a class the best one, `top_k: {self.top_k}` leaves the best classes: "
                "use one of the two."
            )

    @property
    def labels(self) -> tuple[int, ...]:
        """All classes that count as the object."""
        return (operator.index(self.label),) if isinstance(self.label, SupportsIndex) else self.label

    def check(self, n_classes: int) -> None:
        """Raise ``SpecError`` for a goal that does not fit a classifier of ``n_classes`` classes."""
        check_labels(self.labels, n_classes)
        for name, index in (*(("label", label) for label in self.labels), ("target class", self.target)):
            if index is not None and not 0 <= index < n_classes:
                raise SpecError(
                    f"The {name} {index} is not one of the classifier's {n_classes} classes (0..{n_classes - 1})."
                )
        check_top_k(self.top_k, n_classes - len(self.labels))

    def reached(self, logits: Logits) -> Bool[Tensor, " views"]:
        """Whether each view is fooled: the class is ``target``, or no true class is among the ``top_k`` best."""
        logits = finite(logits)
        best = logits.argmax(1)
        if self.target is not None:
            return best == self.target
        if self.top_k == 1:
            return torch.isin(best, self._subject(logits), invert=True)
        return (logits > self._own(logits)[:, None]).sum(1) >= self.top_k

    def margins(self, logits: Logits) -> PerView:
        """The k-th best other logit minus the best true one, or the target's minus the best other one; always finite.

        Positive for views that reach the goal.
        """
        logits = finite(logits)
        others = logits.index_fill(1, self._subject(logits), -torch.inf)
        margins = others.topk(self.top_k, dim=1).values[:, -1] - self._own(logits)
        return margins if self.target is None else -margins

    def losses(self, logits: Logits, *, clamped: bool = True) -> PerView:
        """The loss of each view; finite, with a finite gradient.

        ``clamped=False`` is the margin itself, so that all views have an equal gradient.
        """
        if self.loss == "margin":
            margins = self.margins(logits)
            if not clamped:
                return margins
            margins = margins.clamp(max=self.safe)
            return torch.where(margins < 0, self._flattened(margins), margins)
        log_shares = finite(logits).log_softmax(1).index_select(1, self._subject(logits))
        losses = -log_shares.logsumexp(1)  # the probabilities of several classes add up
        return losses if self.target is None else -losses

    def _flattened(self, margins: PerView) -> PerView:
        """Margins below 0, flat beyond ``reach`` but for a slope that lets views be approached if all are hopeless."""
        if math.isinf(self.reach):
            return margins
        return self.reach * torch.tanh(margins / self.reach) + SLOPE * margins

    def settled(self, logits: Logits) -> Bool[Tensor, " views"]:
        """Whether each view is safely won, so that its loss has no gradient."""
        if self.loss != "margin":
            return torch.zeros(len(logits), dtype=torch.bool, device=logits.device)
        return self.margins(logits) >= self.safe

    def _subject(self, logits: Logits) -> Int[Tensor, " _"]:
        """The classes to leave, or the one to reach."""
        return torch.tensor(self.labels if self.target is None else (self.target,), device=logits.device)

    def _own(self, logits: Logits) -> PerView:
        """The best logit of the subject."""
        return logits.index_select(1, self._subject(logits)).max(dim=1).values
