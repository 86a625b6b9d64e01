"""What the attacks beyond texture maximise. They are weak: not every view can be won."""

from jaxtyping import Float
from torch import Tensor

from trompe_server.attack.goal import Goal

__all__ = ["chances"]


def chances(goal: Goal, logits: Float[Tensor, "views classes"]) -> Float[Tensor, " views"]:
    """The chance in (0, 1) of each view being fooled that its margin stands for: the logistic function of it.

    A mean of margins would be ruled by the views that are recognised most surely, and prefer shaking all a little to
    fooling some.
    """
    return goal.margins(logits).sigmoid()
