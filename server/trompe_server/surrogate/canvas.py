"""The moving part of the textures as one flat tensor, and the texels that views read from it.

What moves are texels, or blocks of them. No view sees most texels of a texture. The moving ones are kept in square
tiles, in an order that puts the four texels averaged by the next mip level a quarter of the array apart: a level is the
sum of four contiguous arrays, and the rest of the texture costs nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_server.surrogate.blocks import halvings, means
from trompe_server.surrogate.pyramid import Linear, MipChain, read_texels, round_level_
from trompe_server.surrogate.shading import decode

REACH: Final = 0.1
"""Change of texels at which the light of their block is computed."""

DEPTH: Final = 3
"""Tiles have sides of up to 2 ** DEPTH texels: larger ones contain more fixed texels, smaller ones leave more work to
the complete levels."""


def canvas_of(
    textures: Sequence[Float[Tensor, "H W 3"]],
    moving: Sequence[Bool[Tensor, "h w"]],
    chains: Sequence[MipChain],
    *,
    linear: bool,
    rounded: bool,
) -> "Canvas":
    """The tiles of ``textures`` (sRGB in [0, 1]) with a ``moving`` texel, or a moving block of texels (``blocks``).

    linear: average in linear light instead of encoded values. Other arguments: as for ``read_texels``.
    """
    counts = [halvings(mask.shape, texture.shape) for mask, texture in zip(moving, textures, strict=True)]
    lights = [decode(texture) for texture in textures] if linear else textures
    sheets, source, texels = [], [], []
    for texture, light, mask, chain, count in zip(textures, lights, moving, chains, counts, strict=True):
        tiles, averaged = _Tiles.of(chain.of_blocks(count), mask), means(light, count)
        source.append(means(texture, count).flatten(0, 1).index_select(0, tiles.order))
        found = tiles.fine.read(averaged, rounded=rounded)
        curve = _light_curve(texture, averaged, count).flatten(1, 2)[:, tiles.order] if linear and count else None
        sheets.append(_Sheet(tiles, found[-1], curve))
        texels += [*found[:-1], *(texture.new_zeros(len(level), 3) for level in tiles.coarse.reads)]
    canvas = Canvas(tuple(sheets), torch.cat(source), torch.cat(texels), linear, rounded)
    if not any(counts):
        return canvas
    return replace(canvas, offset=read_texels(lights, chains, rounded=rounded) - canvas.read(canvas.source))


def _light_curve(
    texture: Float[Tensor, "H W 3"], light: Float[Tensor, "h w 3"], count: int
) -> Float[Tensor, "5 h w 3"]:
    """The mean ``light`` of each block, and the coefficients (linear, quadratic) of its parabolas for a darker and a
    brighter mean colour.

    They are exact for no change, and for texels that all change by ``REACH`` or half of it as far as they stay in
    [0, 1].
    """
    colour, found = means(texture, count), [light]
    for side in (-REACH, REACH):
        half, full = ((texture + part * side).clamp(0, 1) for part in (0.5, 1))
        near, far = means(half, count) - colour, means(full, count) - colour
        slope, wider = ((means(decode(each), count) - light) for each in (half, full))
        slope, wider = slope / torch.where(near == 0, 1, near), wider / torch.where(far == 0, 1, far)
        bend = (wider - slope) / torch.where(near == far, 1, far - near)
        found += [slope - near * bend, bend]
    return torch.stack(found)


@dataclass(frozen=True)
class Canvas:
    """The texels that may move, (texels, 3) in an order of its own.

    source: their initial sRGB values. still: the initial texels read by views, sRGB or linear like the averages.
    offset: added to the texels read: what blocks of texels lack of their texture, if any.
    """

    sheets: tuple["_Sheet", ...]
    source: Float[Tensor, "texels 3"]
    still: Float[Tensor, "reads 3"]
    linear: bool
    rounded: bool
    offset: Float[Tensor, "reads 3"] | None = None

    @cached_property
    def counts(self) -> list[int]:
        """Number of texels of each texture that may move."""
        return [len(sheet.tiles.order) for sheet in self.sheets]

    def join(self, tables: Sequence[Tensor]) -> Tensor:
        """Entries (texels, ...) of tables (H, W, ...), one for each texture, at the texels that may move."""
        parts = zip(self.sheets, tables, strict=True)
        return torch.cat([table.flatten(0, 1).index_select(0, sheet.tiles.order) for sheet, table in parts])

    def split(self, values: Tensor) -> list[Tensor]:
        """Inverse of ``join``: tables (H, W, ...), zero at fixed texels."""
        tables = []
        for sheet, part in zip(self.sheets, torch.split(values, self.counts), strict=True):
            height, width = sheet.tiles.fine.sizes[0]
            table = part.new_zeros(height * width, *part.shape[1:]).index_copy_(0, sheet.tiles.order, part)
            tables.append(table.view(height, width, *part.shape[1:]))
        return tables

    def read(self, values: Float[Tensor, "texels 3"]) -> Float[Tensor, "reads 3"]:
        """The texels read by views, as ``Surrogate.texels``, for canvas ``values`` (sRGB). Differentiable."""
        if self.linear:
            parts = zip(
                self.sheets, torch.split(values, self.counts), torch.split(self.source, self.counts), strict=True
            )
            values = torch.cat([sheet.light(part, source) for sheet, part, source in parts])
        texels: Tensor = Linear.apply(self.forward, lambda each: [self.transpose(each)], values)  # type: ignore[no-untyped-call]
        return texels

    def forward(self, values: Float[Tensor, "texels 3"]) -> Float[Tensor, "reads 3"]:
        """``read`` of values in the space of the averages."""
        texels = self.still.clone()
        for sheet, part, reads in zip(self.sheets, torch.split(values, self.counts), self._split(texels), strict=True):
            sheet.read(part, reads, rounded=self.rounded)
        return texels if self.offset is None else texels.add_(self.offset)

    def transpose(self, gradient: Float[Tensor, "reads 3"]) -> Float[Tensor, "texels 3"]:
        """Gradient of the canvas from the ``gradient`` of the texels read by views."""
        parts = zip(self.sheets, self._split(gradient), strict=True)
        return torch.cat([sheet.spread(reads) for sheet, reads in parts])

    def _split(self, reads: Float[Tensor, "reads 3"]) -> tuple[Tensor, ...]:
        return torch.split(reads, [sheet.tiles.n_reads for sheet in self.sheets])


@dataclass(frozen=True)
class _Tiles:
    """The tiles of one texture with texels that may move.

    fine: the mip levels computed tile by tile, and the first complete one (all of it is read). coarse: that level and
    the following ones. tiles: the tiles as texels of that level, ascending. order: the texels (row * width + column) of
    all tiles, indexed by (position in the 2 x 2 block of level 0, of level 1, ..., tile).
    hits: for each fine level the reads within tiles, and their places.
    """

    fine: MipChain
    coarse: MipChain
    tiles: Int[Tensor, " tiles"]
    order: Int[Tensor, " texels"]
    hits: tuple[tuple[Int[Tensor, " _"], Int[Tensor, " _"]], ...]

    @classmethod
    def of(cls, chain: MipChain, moving: Bool[Tensor, "H W"]) -> "_Tiles":
        depth = next((k for k, (h, w) in enumerate(chain.sizes[:DEPTH]) if h % 2 or w % 2), DEPTH)
        height, width = chain.sizes[depth]
        side = 2**depth
        rows = moving.byte().view(height, side, -1).amax(1)
        tiles = rows.view(height, width, side).amax(2).flatten().nonzero()[:, 0]
        everything = torch.arange(height * width, device=moving.device)
        place = torch.full_like(everything, -1).index_copy_(0, tiles, everything[: len(tiles)])
        fine = MipChain(chain.sizes[: depth + 1], (*chain.reads[:depth], everything))
        coarse = MipChain(chain.sizes[depth:], chain.reads[depth:])
        hits = tuple(_hits(fine, level, place, len(tiles)) for level in range(depth))
        return cls(fine, coarse, tiles, _order(tiles, width, depth), hits)

    @property
    def n_reads(self) -> int:
        """Number of texels read by views from all levels of this texture."""
        return sum(map(len, self.fine.reads[:-1])) + sum(map(len, self.coarse.reads))


def _order(tiles: Int[Tensor, " tiles"], width: int, depth: int) -> Int[Tensor, " texels"]:
    """The texels of level 0 of ``tiles``, given as texels of level ``depth`` with ``width`` in a row."""
    order = tiles
    for level in reversed(range(depth)):
        across = width << depth - level
        order = order // (across // 2) * (2 * across) + order % (across // 2) * 2
        corners = torch.tensor([0, 1, across, across + 1], device=tiles.device)
        order = (corners[:, None] + order).flatten()
    return order


def _hits(
    fine: MipChain, level: int, place: Int[Tensor, " coarse"], n_tiles: int
) -> tuple[Int[Tensor, " hits"], Int[Tensor, " hits"]]:
    """(Reads of a fine level within tiles, their places among the texels of all tiles of the level)."""
    depth = len(fine.sizes) - 1 - level
    reads, width = fine.reads[level], fine.sizes[level][1]
    row, column = reads // width, reads % width
    tile = place[(row >> depth) * (width >> depth) + (column >> depth)]
    inside = (tile >= 0).nonzero()[:, 0]
    row, column, where = row[inside], column[inside], tile[inside]
    for finer in range(depth):
        corner = 2 * ((row >> finer) & 1) + ((column >> finer) & 1)
        where = where + corner * (4 ** (depth - 1 - finer) * n_tiles)
    return inside, where


@dataclass(frozen=True)
class _Sheet:
    """The tiles of one texture, and its first complete level before anything moves.

    curve: light of blocks of texels, as ``_light_curve``, if they are averaged in linear light.
    """

    tiles: _Tiles
    around: Float[Tensor, "coarse 3"]
    curve: Float[Tensor, "5 texels 3"] | None

    def light(self, values: Float[Tensor, "texels 3"], source: Float[Tensor, "texels 3"]) -> Float[Tensor, "texels 3"]:
        """Linear light of sRGB ``values`` in the place of ``source``. Differentiable."""
        if self.curve is None:
            return decode(values)
        light, slope_down, bend_down, slope_up, bend_up = self.curve.unbind()
        change = values - source
        slope, bend = torch.where(change < 0, slope_down, slope_up), torch.where(change < 0, bend_down, bend_up)
        return light + change * (slope + change * bend)

    def read(self, values: Float[Tensor, "texels 3"], reads: Float[Tensor, "reads 3"], *, rounded: bool) -> None:
        """Write the moving texels of each level into ``reads``."""
        tiles, start = self.tiles, 0
        for (inside, where), level in zip(tiles.hits, tiles.fine.reads, strict=False):
            reads[start : start + len(level)].index_copy_(0, inside, values.index_select(0, where))
            values, start = _averaged(values, rounded=rounded), start + len(level)
        whole = self.around.index_copy(0, tiles.tiles, values).view(*tiles.coarse.sizes[0], 3)
        torch.cat(tiles.coarse.read(whole, rounded=rounded), out=reads[start:])

    def spread(self, reads: Float[Tensor, "reads 3"]) -> Float[Tensor, "texels 3"]:
        """The transpose of ``read``."""
        tiles = self.tiles
        counts = [len(level) for level in (*tiles.fine.reads[:-1], *tiles.coarse.reads)]
        parts, depth = torch.split(reads, counts), len(tiles.hits)
        total = tiles.coarse.spread(parts[depth:]).view(-1, 3).index_select(0, tiles.tiles)
        for level in reversed(range(depth)):
            inside, where = tiles.hits[level]
            total = total.div(4).repeat(4, 1)
            total.index_add_(0, where, parts[level].index_select(0, inside))
        return total


def _averaged(values: Float[Tensor, "texels 3"], *, rounded: bool) -> Float[Tensor, "quarter 3"]:
    """The next level of all tiles: the mean of columns, then of rows."""
    values = values.view(2, 2, len(values) // 4, 3)
    for axis in (1, 0):
        first, second = values.unbind(axis)
        values = (first + second).div_(2)
        if rounded:
            round_level_(values)
    return values
