"""What the attack maximises."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["SAFE_MARGIN", "fooled", "margin", "margin_loss"]

SAFE_MARGIN = 3.0
"""A view whose best other logit leads by this much is safely fooled: no more gradient is spent on it."""


def margin(logits: Float[Tensor, "views classes"], label: int) -> Float[Tensor, " views"]:
    """Best other logit minus the true one: positive where the classifier is fooled (Carlini and Wagner, 2017)."""
    others = logits.clone()
    others[:, label] = -torch.inf
    return others.amax(1) - logits[:, label]


def fooled(logits: Float[Tensor, "views classes"], label: int) -> Bool[Tensor, " views"]:
    """Where the predicted class is another than ``label``."""
    return logits.argmax(1) != label


def margin_loss(logits: Float[Tensor, "views classes"], label: int) -> Float[Tensor, " views"]:
    """The margin of each view, clamped once it is safely fooled. No gradient there, and finite everywhere."""
    return margin(logits, label).clamp(max=SAFE_MARGIN)
