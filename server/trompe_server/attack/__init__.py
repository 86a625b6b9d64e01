"""The attack: budget, goal, saliency, views and the loop. Usable without any server."""

from trompe_server.attack.attack import AttackState, Step, attack, load_state, movable, save_state, start
from trompe_server.attack.budget import Budget
from trompe_server.attack.goal import fooled, margin, margin_loss
from trompe_server.attack.saliency import saliency, saliency_masks
from trompe_server.attack.views import framing_distance, grid_views, random_views

__all__ = [
    "AttackState",
    "Budget",
    "Step",
    "attack",
    "fooled",
    "framing_distance",
    "grid_views",
    "load_state",
    "margin",
    "margin_loss",
    "movable",
    "random_views",
    "saliency",
    "saliency_masks",
    "save_state",
    "start",
]
