"""Which texels an attack may touch: those that matter, that were painted, that are of a material, the best few."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.attack.budget import Budget
from trompe_server.attack.objective import Textures
from trompe_server.checks import check_mask_size
from trompe_server.surrogate import Surrogate
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

__all__ = ["TexelMasks", "best_texels", "collect", "material_texels", "movable", "painted_texels", "rank_texels"]

TexelMasks = Mapping[str, Bool[Tensor, "H W"]]

PAINTED: Final = 128
"""Grey level from which a pixel of a mask image counts as painted."""


def movable(
    surrogate: Surrogate,
    budget: Budget,
    masks: Bool[Tensor, "views H W"] | None = None,
    *,
    within: Sequence[TexelMasks] = (),
) -> TexelMasks:
    """The texels worth moving: those whose whole budget changes the attack's pixels by half an 8-bit level or more in
    total.

    Coarse mip levels let a pixel at a grazing angle read a little of every texel. Without this rule a sign step would
    move them all at full size for an effect nobody can see. ``masks`` (saliency): only those pixels count. ``within``:
    only texels that are in all of these move. Raises ``SpecError`` where masks leave none.
    """
    least = 0.5 / 255 / budget.epsilon
    found = {name: weight >= least for name, weight in surrogate.influence(masks).items()}
    for mask in within:
        found = {name: texels & mask[name].to(texels.device) for name, texels in found.items()}
    if (masks is not None or within) and not any(texels.any() for texels in found.values()):
        raise SpecError(
            f"No texel is left that the attack may move and that changes a pixel visibly at epsilon={budget.epsilon:g}"
            f"{': the pixels of saliency tau or more show none of the object' if not within else ''}. "
            f"{'Lower tau, or ' if masks is not None else ''}{'widen the texel masks, or ' if within else ''}"
            "raise epsilon."
        )
    return found


def painted_texels(obj: Object3D, images: Mapping[str, NDArray[np.uint8]]) -> TexelMasks:
    """The texels that are white (128 or more on average) in mask images (H, W, 3) of the textures' own sizes.

    Textures without a mask image are left alone entirely. Raises ``SpecError`` for an image of another size or of a
    texture that there is not, and where nothing is painted.
    """
    for name, image in images.items():
        if name not in obj.textures:
            raise SpecError(f"There is no texture {name!r} to mask; {obj.name!r} has {sorted(obj.textures)}.")
        check_mask_size(name, size=obj.textures[name].shape[:2], mask=image.shape[:2])
    masks = {
        name: torch.from_numpy(images[name].mean(2) >= PAINTED)
        if name in images
        else torch.zeros(texture.shape[:2], dtype=torch.bool)
        for name, texture in obj.textures.items()
    }
    if not any(mask.any() for mask in masks.values()):
        raise SpecError("The mask images leave no texel to move: paint white where the texture may change.")
    return masks


def material_texels(obj: Object3D, materials: Sequence[str]) -> TexelMasks:
    """All texels of the textures of ``materials``.

    Raises ``SpecError`` for a material that there is not, and for a texture that a material beside these uses too.
    """
    unknown = sorted(set(materials) - set(obj.materials))
    if unknown or not materials:
        raise SpecError(f"There is no material {unknown or '(none named)'}; {obj.name!r} has {sorted(obj.materials)}.")
    chosen = {obj.materials[name].albedo for name in materials}
    others = sorted(name for name, other in obj.materials.items() if name not in materials and other.albedo in chosen)
    if others:
        raise SpecError(
            f"The materials {others} share a texture with {sorted(materials)}: name them too, or paint a mask image."
        )
    return {name: torch.full(texture.shape[:2], name in chosen) for name, texture in obj.textures.items()}


def rank_texels(
    surrogate: Surrogate, textures: Textures, maps: Float[Tensor, "views H W"] | Float[Tensor, "views H W 3"]
) -> Mapping[str, Float[Tensor, "H W"]]:
    """How much each texel matters: what the ``maps`` of all views say of the pixels, accumulated where a texel shows.

    ``maps`` are saliencies, or ``image_gradients``: with their signs, so that a texel that views would pull to and fro
    counts little. That is the better ranking.
    """
    return {name: pull.abs().sum(2) for name, pull in collect(surrogate, textures, maps).items()}


def collect(
    surrogate: Surrogate, textures: Textures, maps: Float[Tensor, "views H W"] | Float[Tensor, "views H W 3"]
) -> Mapping[str, Float[Tensor, "H W 3"]]:
    """What ``maps`` say of the pixels of all views, carried back: a pixel's value goes to the texels that it reads, by
    weight and by how strongly the pixel answers to them."""
    leaves = {name: texture.clone().requires_grad_() for name, texture in textures.items()}
    texels = surrogate.texels(leaves)
    collected = texels.detach().requires_grad_()
    for batch, views in enumerate(surrogate.batches):
        images = surrogate.render(collected, batch)
        weights = maps[views.start : views.stop].to(images)
        weights = weights[:, None] if maps.ndim == 3 else weights.permute(0, 3, 1, 2)
        images.backward(weights.expand_as(images))  # type: ignore[no-untyped-call]
    return dict(zip(leaves, torch.autograd.grad(texels, list(leaves.values()), collected.grad), strict=True))


def best_texels(scores: Mapping[str, Float[Tensor, "H W"]], keep: float) -> TexelMasks:
    """The share ``keep``, in (0, 1], of all texels with the highest scores; of equal ones the first. None that has no
    score. Raises ``SpecError`` where ``keep`` is out of range or leaves none.
    """
    if not 0 < keep <= 1:
        raise SpecError(f"The share of texels to keep must be in (0, 1], got {keep}.")
    everything = torch.cat([score.flatten() for score in scores.values()])
    order = everything.sort(descending=True, stable=True).indices[: round(keep * len(everything))]
    chosen = torch.zeros_like(everything, dtype=torch.bool).index_fill_(0, order, True) & (everything > 0)
    if not chosen.any():
        raise SpecError(f"A share of {keep:g} leaves none of the {len(everything)} texels to move; keep more.")
    parts = torch.split(chosen, [score.numel() for score in scores.values()])
    return {name: part.view_as(score) for (name, score), part in zip(scores.items(), parts, strict=True)}
