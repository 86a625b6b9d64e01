"""The mip pyramids of all textures as one flat array; only the texels that views read are ever assembled.

Large levels are computed, read and dropped in bands of rows within the processor's cache, forward and backward, so that
memory latency does not dominate the cost of a step.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

Reads = Sequence[Int[Tensor, " _"]]
"""For each mip level in the layout's order, texels (row * width + column) in the requested order."""

Levels = Int[Tensor, "levels 3"]
"""(H, W, first texel in the flat array) of the mip levels of one texture."""

BAND_TEXELS = 2**18
"""Texels of a band; larger levels are computed in bands."""


@dataclass(frozen=True)
class MipLayout:
    """Places of the mip levels in the flat array: ``sizes[t][l]`` is (H, W), ``starts[t][l]`` the first texel."""

    sizes: tuple[tuple[tuple[int, int], ...], ...]
    starts: tuple[tuple[int, ...], ...]
    total: int

    def levels(self, texture: int, device: torch.device) -> Levels:
        """The levels of one texture, by its number."""
        pairs = zip(self.sizes[texture], self.starts[texture], strict=True)
        return torch.tensor([(*size, start) for size, start in pairs], device=device)


def mip_layout(sizes: Sequence[tuple[int, int]]) -> MipLayout:
    """Layout of the full mip pyramids (halved and rounded down until 1 x 1) of textures of ``sizes`` (H, W)."""
    levels, starts, position = [], [], 0
    for height, width in sizes:
        chain = [(height, width)]
        while chain[-1] != (1, 1):
            chain.append((max(1, chain[-1][0] // 2), max(1, chain[-1][1] // 2)))
        first = []
        for h, w in chain:
            first.append(position)
            position += h * w
        levels.append(tuple(chain))
        starts.append(tuple(first))
    return MipLayout(tuple(levels), tuple(starts), position)


def read_texels(
    textures: Sequence[Float[Tensor, "H W channels"]], chains: Sequence["MipChain"], *, rounded: bool = False
) -> Float[Tensor, "texels channels"]:
    """The texels that ``chains`` read from the box-filtered mip levels of ``textures`` (row 0 on top). Differentiable.

    rounded: round each level to 8 bits; the gradient ignores the rounding.
    """

    def read(*textures: Tensor) -> Tensor:
        pairs = zip(chains, textures, strict=True)
        return torch.cat([part for chain, texture in pairs for part in chain.read(texture, rounded=rounded)])

    def spread(gradient: Tensor) -> list[Tensor]:
        parts = iter(torch.split(gradient, [len(level) for chain in chains for level in chain.reads]))
        return [chain.spread([next(parts) for _ in chain.sizes]) for chain in chains]

    texels: Tensor = Linear.apply(read, spread, *textures)  # type: ignore[no-untyped-call]
    return texels


class Linear(Function):
    """A linear map of tensors as an autograd function; its transpose gives the gradient of each."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, read: Callable[..., Tensor], spread: Callable[[Tensor], Sequence[Tensor]], *tensors: Tensor
    ) -> Tensor:
        ctx.spread = spread  # type: ignore[attr-defined]
        return read(*tensors)

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return (None, None, *ctx.spread(gradient))  # type: ignore[attr-defined]


def mip_chains(layout: MipLayout, reads: Reads) -> list["MipChain"]:
    """The mip levels of each texture with their reads."""
    levels = iter(reads)
    return [MipChain(sizes, tuple(next(levels) for _ in sizes)) for sizes in layout.sizes]


@dataclass(frozen=True)
class MipChain:
    """The mip levels of one texture and their reads."""

    sizes: tuple[tuple[int, int], ...]
    reads: tuple[Int[Tensor, " _"], ...]

    def of_blocks(self, halvings: int) -> "MipChain":
        """The chain of a texture stored coarser by ``halvings`` levels; finer reads become reads of its level 0."""
        width, finest = self.sizes[halvings][1], []
        for finer, level in zip(range(halvings, -1, -1), self.reads, strict=False):
            row, column = level // (width << finer), level % (width << finer)
            finest.append((row >> finer) * width + (column >> finer))
        return MipChain(self.sizes[halvings:], (torch.cat(finest), *self.reads[halvings + 1 :]))

    @cached_property
    def banded(self) -> int:
        """Number of leading levels computed in bands: the large ones with even sides."""
        small = (k for k, (h, w) in enumerate(self.sizes) if h * w <= BAND_TEXELS or h % 2 or w % 2)
        return next(small, len(self.sizes) - 1)

    @cached_property
    def by_row(self) -> list[tuple[Int[Tensor, " _"], Int[Tensor, " _"]]]:
        """(Reads of each banded level in ascending order, their original positions)."""
        return [(order.values, order.indices) for order in (level.sort() for level in self.reads[: self.banded])]

    def bands(self) -> Iterator[list["_Strip"]]:
        """For each band the strips of all banded levels."""
        banded, (height, width) = self.banded, self.sizes[0]
        tall = max(1, BAND_TEXELS // width >> banded)
        starts = range(0, height >> banded, tall)
        edges = [
            torch.searchsorted(level, torch.tensor([(s << banded >> k) * w for s in starts], device=level.device))
            for k, ((level, _), (_, w)) in enumerate(zip(self.by_row, self.sizes, strict=False))
        ]
        places = [[*edge.tolist(), len(level)] for edge, level in zip(edges, self.reads, strict=False)]
        for number, start in enumerate(starts):
            stop = min(start + tall, height >> banded)
            rows = [slice(start << banded >> k, stop << banded >> k) for k in range(banded)]
            yield [self._strip(k, rows[k], slice(*place[number : number + 2])) for k, place in enumerate(places)]

    def _strip(self, level: int, rows: slice, places: slice) -> "_Strip":
        texels, which = self.by_row[level]
        return _Strip(rows, which[places], texels[places].sub(rows.start * self.sizes[level][1]))

    def read(self, texture: Float[Tensor, "H W channels"], *, rounded: bool) -> list[Float[Tensor, "_ channels"]]:
        """The texels read from each level (large levels band by band)."""
        banded, channels = self.banded, texture.shape[2]
        found = [texture.new_empty(len(reads), channels) for reads in self.reads[:banded]]
        level = texture.new_empty(*self.sizes[banded], channels) if banded else texture
        for band in self.bands() if banded else ():
            part = texture[band[0].rows]
            for strip, reads in zip(band, found, strict=True):
                reads.index_copy_(0, strip.which, part.reshape(-1, channels).index_select(0, strip.texels))
                part = halved(part, rounded=rounded)
            level[strip.rows.start // 2 : strip.rows.stop // 2] = part
        for k in range(banded, len(self.sizes)):
            found.append(level.reshape(-1, channels).index_select(0, self.reads[k]))
            level = halved(level, rounded=rounded)
        return found

    def spread(self, gradients: Sequence[Float[Tensor, "_ channels"]]) -> Float[Tensor, "H W channels"]:
        """The transpose of ``read``: the texture's gradient from the gradients of the reads of each level."""
        banded, channels = self.banded, gradients[0].shape[1]
        total = gradients[0].new_zeros(*self.sizes[-1], channels)
        for k in reversed(range(banded, len(self.sizes))):
            total = total if total.shape[:2] == self.sizes[k] else _doubled(total, self.sizes[k])
            total.view(-1, channels).index_add_(0, self.reads[k], gradients[k])
        if not banded:
            return total
        whole = total.new_empty(*self.sizes[0], channels)
        for band in self.bands():
            rows = band[-1].rows
            part = total[rows.start // 2 : rows.stop // 2]
            for k, strip in reversed(list(enumerate(band))):
                size = (strip.rows.stop - strip.rows.start, self.sizes[k][1])
                part = _doubled(part, size, out=whole[strip.rows] if k == 0 else None)
                part.view(-1, channels).index_add_(0, strip.texels, gradients[k].index_select(0, strip.which))
        return whole


@dataclass(frozen=True)
class StoredChain:
    """The mip levels of one 8-bit texture, for many reads of different texels without a gradient.

    first: level 0 as it is stored, (texels, 3) uint8. levels: the others, (texels, 3). table: value of each byte.
    """

    first: UInt8[Tensor, "texels 3"]
    levels: tuple[Float[Tensor, "_ 3"], ...]
    table: Float[Tensor, "256"]

    @classmethod
    def of(cls, texture: UInt8[Tensor, "H W 3"], table: Float[Tensor, "256"], *, rounded: bool) -> "StoredChain":
        """The levels of ``read_texels``, of the values that ``table`` gives to the bytes of ``texture``."""
        height, width = texture.shape[:2]
        levels = []
        if (height, width) != (1, 1):
            tall = max(1, BAND_TEXELS // width) * 2 if height % 2 == 0 else height
            bands = [table[texture[row : row + tall].int()] for row in range(0, height, tall)]
            levels.append(torch.cat([halved(band, rounded=rounded) for band in bands]))
        while levels and levels[-1].shape[:2] != (1, 1):
            levels.append(halved(levels[-1], rounded=rounded))
        return cls(texture.flatten(0, 1), tuple(level.flatten(0, 1) for level in levels), table)

    def read(self, reads: Reads) -> list[Float[Tensor, "_ 3"]]:
        """The texels ``reads`` of each level."""
        coarser = [level.index_select(0, texels) for level, texels in zip(self.levels, reads[1:], strict=True)]
        return [self.table[self.first.index_select(0, reads[0]).int()], *coarser]

    @property
    def nbytes(self) -> int:
        """Memory in bytes, without the texture itself."""
        return sum(level.nbytes for level in self.levels)


@dataclass(frozen=True)
class _Strip:
    """A band's part of one level: its rows, the level's reads within them, and their texels."""

    rows: slice
    which: Int[Tensor, " _"]
    texels: Int[Tensor, " _"]


def halved(level: Float[Tensor, "H W channels"], *, rounded: bool) -> Float[Tensor, "h w channels"]:
    """The next mip level: means of columns, then rows, in pairs; of odd sides weighted means of triples."""
    for axis in (1, 0):
        if level.shape[axis] > 1:
            first, second, *third = _windows(level, axis)
            if not third:
                level = (first + second).div_(2)
            else:
                one, two, three = _weights(level, axis)
                level = (first * one).addcmul_(second, two).addcmul_(third[0], three)
            if rounded:
                round_level_(level)
    return level


def round_level_(level: Float[Tensor, "*texels channels"]) -> None:
    """Round a level to 8 bits, in place."""
    level.mul_(255).add_(0.5 + 1e-4).floor_().div_(255)


def _windows(level: Float[Tensor, "H W channels"], axis: int) -> list[Tensor]:
    """The first, second and (for odd sides) third texels of each mean along ``axis``."""
    side = level.shape[axis]
    steps = [slice(k, k + side // 2 * 2 - 1, 2) for k in range(2 + side % 2)]
    return [level[step] if axis == 0 else level[:, step] for step in steps]


def _weights(level: Float[Tensor, "H W channels"], axis: int) -> list[Tensor]:
    """Weights of the ``_windows`` of an odd side: bilinear at the centre of each new texel, as drivers scale a level.

    A new texel lies anywhere from between the first two texels to between the last two, in order along the side.
    """
    half = level.shape[axis] // 2
    place = (torch.arange(half, device=level.device, dtype=level.dtype) + 0.5) / half
    place = place.view(-1, *[1] * (2 - axis))
    return [(0.5 - place).clamp(min=0), 1 - (place - 0.5).abs(), (place - 0.5).clamp(min=0)]


def _doubled(
    total: Float[Tensor, "h w channels"], size: tuple[int, int], *, out: Tensor | None = None
) -> Float[Tensor, "H W channels"]:
    """The transpose of averaging a level of ``size`` (H, W), in a new tensor or, for even sides, in ``out``."""
    if size[0] % 2 or size[1] % 2:
        return _shared(_shared(total, size[1], 1), size[0], 0)
    quarter = total / 4
    wide = torch.stack([quarter, quarter], 2).view(len(total), 1, -1)
    whole = total.new_empty(*size, total.shape[2]) if out is None else out
    pairs = whole.view(len(total), 2, -1)
    pairs.copy_(wide.expand_as(pairs))
    return whole


def _shared(total: Float[Tensor, "h w channels"], side: int, axis: int) -> Tensor:
    """Distribute the gradient of each mean to its two or three texels, ``side`` of them along ``axis``."""
    if side == 1:
        return total.clone()
    if side % 2 == 0:
        return torch.stack([half := total / 2, half], axis + 1).flatten(axis, axis + 1)
    shape = list(total.shape)
    shape[axis] = side
    wide = total.new_zeros(shape)
    for window, weight in zip(_windows(wide, axis), _weights(wide, axis), strict=True):
        window += total * weight
    return wide
