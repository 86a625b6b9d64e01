"""Square blocks of texels that move together, where a texture is stored more finely than views show it.

No view tells the texels of such a block apart: it reads a mip level in which they are averaged. A change of their mean
is all that an attack needs, so that its cost depends on what views show and not on the size of the stored picture.

A table of blocks is smaller than its texture by the same power of two along both sides. Its shape says how large the
blocks are; a block of one texel is the texel itself.
"""

from typing import Final

import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from trompe_server.surrogate.pyramid import halved

Blocks = Float[Tensor, "h w 3"]

ROUNDS: Final = 32
"""Most rounds of ``common_change``; two or three are usual."""

PORTION: Final = 2**18
"""Texels that are looked at together: within the processor's cache."""

EXACT: Final = 1e-4
"""Largest error of a block's mean, in [0, 1] units: a fortieth of an 8-bit level."""


def halvings(blocks: tuple[int, ...], texels: tuple[int, ...]) -> int:
    """Log2 of the side of a block, from the shapes of a table of blocks and of its texture."""
    return (texels[0] // blocks[0]).bit_length() - 1


def most_halvings(size: tuple[int, ...], wanted: int) -> int:
    """The largest possible log2, up to ``wanted``, of the side of the blocks of a texture of ``size``."""
    return next(k for k in range(wanted, -1, -1) if not any(side % 2**k for side in size[:2]))


def by_block(table: Shaped[Tensor, "H W ..."], count: int) -> Shaped[Tensor, "h rows w columns ..."]:
    """The texels of each block of side ``2 ** count``; no copy."""
    side = 2**count
    return table.view(table.shape[0] // side, side, table.shape[1] // side, side, *table.shape[2:])


def means(table: Float[Tensor, "H W c"], count: int) -> Float[Tensor, "h w c"]:
    """Mean of each block of side ``2 ** count``."""
    for _ in range(count):
        table = halved(table, rounded=False)
    return table


def whole(mask: Bool[Tensor, "H W"], count: int) -> Bool[Tensor, "h w"]:
    """The blocks of side ``2 ** count`` all of whose texels are in ``mask``."""
    return by_block(mask.byte(), count).amin(1).amin(2).bool()


def repeated(blocks: Shaped[Tensor, "h w ..."], texels: tuple[int, ...]) -> Shaped[Tensor, "H W ..."]:
    """A table of the shape ``texels``, (H, W, ...), whose texels have the values of their ``blocks``."""
    side = 2 ** halvings(blocks.shape, texels)
    return blocks.repeat_interleave(side, 0).repeat_interleave(side, 1)


def rooms(texture: Float[Tensor, "H W 3"], bound: Float[Tensor, "h w 1"], count: int) -> tuple[Blocks, Blocks]:
    """The largest changes (down, up) of each block's mean if no texel changes by more than ``bound`` or leaves [0, 1].

    Both are positive or zero.
    """
    tall = max(1, PORTION // texture.shape[1] >> count)
    down: list[Tensor] = []
    up: list[Tensor] = []
    for part, limit in zip(torch.split(texture, tall << count), torch.split(bound, tall), strict=True):
        texels, limit = by_block(part, count), limit[:, None, :, None]
        for found, room in ((down, texels), (up, 1 - texels)):
            found.append(means(torch.minimum(room, limit).view_as(part), count))
    return torch.cat(down), torch.cat(up)


def common_change(mean: Blocks, texture: UInt8[Tensor, "H W 3"]) -> Blocks:
    """The change that all texels of a block make, as far as they stay in [0, 1], to change its mean by ``mean``.

    Within ``rooms`` of a bound it is within this bound. Newton's method, which does not overshoot: the mean is a
    piecewise linear, concave function of the size of the change.
    """
    count = halvings(mean.shape, texture.shape)
    if not count:
        return mean
    texels = by_block(texture, count).permute(4, 0, 2, 1, 3).flatten(0, 2).flatten(1)  # (3 h w, texels of a block)
    change = mean.permute(2, 0, 1).flatten().clone()
    low, high = texels.amin(1) / 255, texels.amax(1) / 255
    cut = ((low + change < 0) | (high + change > 1)).nonzero()[:, 0]
    for some in torch.split(cut, max(1, PORTION >> 2 * count)) if len(cut) else ():
        change[some] = _found(change[some], texels[some] / 255)
    return change.view(3, *mean.shape[:2]).permute(1, 2, 0)


def _found(mean: Float[Tensor, " blocks"], texels: Float[Tensor, "blocks texels"]) -> Float[Tensor, " blocks"]:
    """``common_change`` of one channel of some blocks."""
    change = mean
    for _ in range(ROUNDS):
        changed = texels + change[:, None]
        missing = mean - (changed.clamp(0, 1) - texels).mean(1)
        if missing.abs().max() <= EXACT:
            break
        free = ((changed > 0) & (changed < 1)).float().mean(1)
        change = change + missing / free.clamp(min=1 / texels.shape[1])
    return change
