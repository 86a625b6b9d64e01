"""The attack: budget, goal, saliency, views and the loop. Usable without any server."""

from trompe_server.attack.attack import Step, attack
from trompe_server.attack.backgrounds import Backgrounds
from trompe_server.attack.budget import Budget
from trompe_server.attack.few import FewTexels, few_texels
from trompe_server.attack.goal import Goal
from trompe_server.attack.saliency import image_gradients, saliency, saliency_masks
from trompe_server.attack.state import AttackState, load_state, save_state, start
from trompe_server.attack.texels import TexelMasks, best_texels, material_texels, movable, painted_texels, rank_texels
from trompe_server.attack.views import ViewDistribution, grid_views

__all__ = [
    "AttackState",
    "Backgrounds",
    "Budget",
    "FewTexels",
    "Goal",
    "Step",
    "TexelMasks",
    "ViewDistribution",
    "attack",
    "best_texels",
    "few_texels",
    "grid_views",
    "image_gradients",
    "load_state",
    "material_texels",
    "movable",
    "painted_texels",
    "rank_texels",
    "saliency",
    "saliency_masks",
    "save_state",
    "start",
]
