"""Selection of texels: visible ones, ranked ones, by material, by painted masks."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.attack.budget import Budget
from trompe_server.attack.objective import Textures
from trompe_server.spec.checks import check_mask_size
from trompe_server.surrogate import AnySurrogate
from trompe_server.surrogate.blocks import most_halvings, whole
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D

TexelMasks = Mapping[str, Bool[Tensor, "H W"]]
ImageMaps = Float[Tensor, "views H W"] | Float[Tensor, "views H W 3"]

CUT: Final = 0.01
"""Largest share of the moving texels that may stay because their blocks contain fixed ones."""

VISIBLE: Final = 4.0
"""Change of all views together, in 8-bit levels, from which a texel counts as visible."""

PAINTED: Final = 128
"""Grey level from which a pixel of a mask image counts as painted."""


def movable(
    surrogate: AnySurrogate,
    budget: Budget,
    masks: Bool[Tensor, "views H W"] | None = None,
    *,
    within: Sequence[TexelMasks] = (),
) -> TexelMasks:
    """The texels with a visible effect: the whole budget of as many of them as a pixel reads (``footprint``) changes
    the views by at least ``VISIBLE`` 8-bit levels in total.

    Coarse mip levels let a pixel at a grazing angle read a little of every texel; without this rule a sign step would
    move all of them at full size without visible effect. Texels of a fine texture act together, so the rule selects
    the same part of a picture at any resolution. ``masks`` (saliency): count only these pixels. ``within``: keep only
    texels in all of these masks. Raises ``SpecError`` if no texel is left.
    """
    least, footprint = VISIBLE / 255 / budget.epsilon, surrogate.footprint
    found = {name: weight * footprint[name] >= least for name, weight in surrogate.influence(masks).items()}
    for mask in within:
        found = {name: texels & mask[name].to(texels.device) for name, texels in found.items()}
    if not any(texels.any() for texels in found.values()):
        raise _nothing_visible(budget, masked=masks is not None, within=bool(within))
    return found


def moving_blocks(texels: TexelMasks, spare_levels: Mapping[str, int]) -> TexelMasks:
    """The moving ``texels`` in the largest square blocks that the surrogate's ``spare_levels`` allow.

    A block moves if all its texels may. The blocks are smaller where more than a share ``CUT`` of the texels would stay
    for that reason, down to single texels.
    """
    return {name: _blocks(mask, most_halvings(mask.shape, spare_levels[name])) for name, mask in texels.items()}


def _blocks(mask: Bool[Tensor, "H W"], most: int) -> Bool[Tensor, "h w"]:
    enough = (1 - CUT) * int(mask.sum())
    found = ((count, whole(mask, count)) for count in range(most, 0, -1))
    return next((blocks for count, blocks in found if int(blocks.sum()) * 4**count >= enough), mask)


def _nothing_visible(budget: Budget, *, masked: bool, within: bool) -> SpecError:
    hints = ["Lower `tau`"] * masked + ["widen the texel masks"] * within or ["Come closer by `distance`"]
    why = ": the pixels of saliency `tau` or more show none of the object" if masked and not within else ""
    return SpecError(
        f"No {'allowed ' * (masked or within)}texel changes a pixel visibly at epsilon={budget.epsilon:g}{why}. "
        f"{', or '.join([*hints, 'raise `epsilon`'])}."
    )


def painted_texels(obj: Object3D, images: Mapping[str, NDArray[np.uint8]]) -> TexelMasks:
    """The texels that are white (128 or more on average) in mask images (H, W, 3) of the textures' sizes.

    Textures without a mask image have none. Raises ``SpecError`` for an unknown texture, another size, or an empty
    mask.
    """
    for name, image in images.items():
        if name not in obj.textures:
            raise SpecError(f"{obj.name!r} has no texture {name!r} to mask; it has {sorted(obj.textures)}.")
        check_mask_size(name, size=obj.textures[name].shape[:2], mask=image.shape[:2])
    masks = {
        name: torch.from_numpy(images[name].mean(2) >= PAINTED)
        if name in images
        else torch.zeros(texture.shape[:2], dtype=torch.bool)
        for name, texture in obj.textures.items()
    }
    if not any(mask.any() for mask in masks.values()):
        raise SpecError("The mask images select no texel: paint white where the texture may change.")
    return masks


def material_texels(obj: Object3D, materials: Sequence[str]) -> TexelMasks:
    """All texels of the textures of ``materials``.

    Raises ``SpecError`` for an unknown material, and for a texture shared with a material not named.
    """
    unknown = sorted(set(materials) - set(obj.materials))
    if unknown or not materials:
        raise SpecError(f"{obj.name!r} has no material {unknown or '(none named)'}; it has {sorted(obj.materials)}.")
    chosen = {obj.materials[name].albedo for name in materials}
    others = sorted(name for name, other in obj.materials.items() if name not in materials and other.albedo in chosen)
    if others:
        raise SpecError(
            f"The materials {others} share a texture with {sorted(materials)}: name them too, or paint a mask image."
        )
    return {name: torch.full(texture.shape[:2], name in chosen) for name, texture in obj.textures.items()}


def rank_texels(surrogate: AnySurrogate, textures: Textures, maps: ImageMaps) -> Mapping[str, Float[Tensor, "H W"]]:
    """Score of each texel: the ``maps`` of all views, accumulated over the pixels that show the texel.

    ``maps`` are saliencies or signed ``image_gradients``. The gradients rank better: a texel that views pull in
    opposite directions scores low.
    """
    return {name: table.abs().sum(2) for name, table in backproject(surrogate, textures, maps).items()}


def backproject(surrogate: AnySurrogate, textures: Textures, maps: ImageMaps) -> Mapping[str, Float[Tensor, "H W 3"]]:
    """``maps`` of all views carried back to the texels: each pixel's value times its derivative by each texel."""
    leaves = {name: texture.clone().requires_grad_() for name, texture in textures.items()}
    texels = surrogate.texels(leaves)
    read = texels.detach().requires_grad_()
    for batch, views in enumerate(surrogate.batches):
        images = surrogate.render(read, batch)
        weights = maps[views.start : views.stop].to(images)
        weights = weights[:, None] if maps.ndim == 3 else weights.permute(0, 3, 1, 2)
        images.backward(weights.expand_as(images))  # type: ignore[no-untyped-call]
    return dict(zip(leaves, torch.autograd.grad(texels, list(leaves.values()), read.grad), strict=True))


def best_texels(scores: Mapping[str, Float[Tensor, "H W"]], keep: float) -> TexelMasks:
    """The share ``keep``, in (0, 1], of all texels with the highest scores; the first ones of equal scores, none with
    score zero. Raises ``SpecError`` if ``keep`` is out of range or leaves no texel.
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
