"""Rasterise each view once: the visible triangle of each sub-sample of each pixel, and the position on it.

Triangles are rasterised in homogeneous coordinates (Olano and Greer, 1997): the perspective-correct barycentrics
divided by depth are *linear* functions of the pixel position. No clipping is needed, the camera may be inside the
object, and UVs and their screen-space derivatives are exact on and beyond a triangle.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_shared.geometry import FIELD_OF_VIEW, Camera
from trompe_shared.object3d import Material, Object3D
from trompe_shared.opacity import opacity_of

CENTRE = ((0.5, 0.5),)
"""One sample at the centre of a pixel."""

MSAA4 = ((0.375, 0.125), (0.875, 0.375), (0.125, 0.625), (0.625, 0.875))
"""The standard sample positions of 4x MSAA (x right, y down, in pixels), common to Direct3D, Vulkan and OpenGL drivers.
"""

MSAA4_MIRRORED = tuple((x, 1 - y) for x, y in MSAA4)
"""The same for renderers with rows from the bottom (OpenGL): the pattern is upside down."""

NEAR = 1e-3
"""Distance of the near plane, metres, for all but tiny objects."""

FACES_AT_ONCE = 2**14
"""Triangles set up at once, within the processor's cache."""

MAX_CANDIDATES = 2_000_000
"""Pixel-triangle pairs tested at once; bounds the rasteriser's memory (about 200 bytes each)."""

TIE = 2**6 - 1
"""Last bits of 1/depth to ignore: triangles in one plane differ in them by rounding. At half a metre that is 3 to 6
micrometres, below the resolution of depth buffers, too.
"""

MARGIN = 1
"""Pixels around the image with triangles, for samples up to a pixel outside of their own."""

ROUNDING = 2.0**-20
"""Error of a barycentric in single precision, relative to its largest term; a few times more than there is."""

LAYERS = 8
"""Most blended triangles in front of each other at one sample; the rest behind them is ignored."""


@dataclass(frozen=True)
class Opacity:
    """Alpha in [0, 1] of faces. blended: over what lies behind, not alpha-tested."""

    alpha: Float[Tensor, "H W"]
    blended: bool


@dataclass(frozen=True)
class Mesh:
    """All triangles of an object.

    positions: metres. uvs: v = 0 is the bottom row. normals: unit length. texture: index into ``textures``, the albedo
    file names. opacity: index into ``opacities``, -1 for an opaque face.
    """

    positions: Float[Tensor, "faces 3 3"]
    uvs: Float[Tensor, "faces 3 2"]
    normals: Float[Tensor, "faces 3 3"]
    texture: Int[Tensor, " faces"]
    textures: tuple[str, ...]
    opacity: Int[Tensor, " faces"]
    opacities: tuple[Opacity, ...] = ()

    @cached_property
    def extent(self) -> float:
        """Diagonal of the bounding box, metres."""
        corners = self.positions.reshape(-1, 3)
        return float((corners.amax(0) - corners.amin(0)).norm()) if len(corners) else 0.0


def mesh_of(obj: Object3D, *, device: torch.device | str = "cpu") -> Mesh:
    """The triangles of ``obj``, in the order of its parts."""
    names = tuple(sorted(obj.textures))
    gathered: dict[str, list[Tensor]] = {"positions": [], "uvs": [], "normals": [], "texture": [], "opacity": []}
    looks = {(look.albedo, look.opacity): look for look in obj.materials.values()}
    opacities = {key: _opacity(look, obj.files[look.albedo], device) for key, look in looks.items()}
    seen_through = [key for key, opacity in opacities.items() if opacity is not None]
    for part in obj.parts:
        faces = torch.from_numpy(part.faces).long()
        gathered["positions"].append(torch.from_numpy(part.vertices)[faces])
        gathered["uvs"].append(torch.from_numpy(part.uvs)[faces])
        gathered["normals"].append(torch.from_numpy(part.normals)[faces])
        gathered["texture"].append(torch.full((len(faces),), names.index(obj.albedo_of(part)), device="cpu"))
        look = obj.materials[part.material]
        key = look.albedo, look.opacity
        number = seen_through.index(key) if key in seen_through else -1
        gathered["opacity"].append(torch.full((len(faces),), number, device="cpu"))
    arrays = {key: torch.cat(value).to(device) for key, value in gathered.items()}
    return Mesh(**arrays, textures=names, opacities=tuple(each for each in opacities.values() if each is not None))


def _opacity(material: Material, albedo: bytes, device: torch.device | str) -> Opacity | None:
    """The opacity of a material with the file ``albedo``; ``None`` if it is opaque."""
    blended = material.opacity is not None
    found = opacity_of(albedo, blended=blended)
    if found is None and not blended:
        return None
    alpha = torch.ones(1, 1) if found is None else torch.from_numpy(found) / 255
    return Opacity(alpha.to(device) * (1.0 if material.opacity is None else material.opacity), blended)


@dataclass(frozen=True)
class Planes:
    """The potentially visible triangles of one view, as linear functions ``a x + b y + c`` of the pixel position.

    face: index into the mesh. edges: barycentric of each corner over depth. box: first and last pixel column and row.
    near: distance of the near plane, metres.
    """

    face: Int[Tensor, " n"]
    edges: Float[Tensor, "n 3 3"]  # (triangle, coefficient a/b/c, corner)
    box: Int[Tensor, "n 4"]  # x0, y0, x1, y1, inclusive
    near: float = NEAR


@dataclass(frozen=True)
class Visibility:
    """Visible triangles of one view: the row of ``planes`` for each (pixel, layer and sample), -1 for none.

    pixel: row * W + column of the pixels with a visible triangle. row: the samples of the blended layers, the front one
    first, then those of the opaque triangles.
    """

    planes: Planes
    pixel: Int[Tensor, " p"]
    row: Int[Tensor, "p layers_samples"]


def project(mesh: Mesh, camera: Camera, size: tuple[int, int], *, cull: bool) -> Planes:
    """Set up the triangles of ``mesh`` for ``camera`` and an image of ``size`` (H, W).

    cull: drop triangles seen from behind (clockwise). Degenerate triangles are always dropped.
    """
    near = min(NEAR, mesh.extent / 10) or NEAR
    groups = torch.split(mesh.positions, FACES_AT_ONCE)
    parts = [_set_up(faces, camera, size, near=near, cull=cull) for faces in groups]
    kept = torch.cat([part.face + k * FACES_AT_ONCE for k, part in enumerate(parts)])
    return Planes(kept, torch.cat([part.edges for part in parts]), torch.cat([part.box for part in parts]), near)


def _set_up(
    positions: Float[Tensor, "faces 3 3"], camera: Camera, size: tuple[int, int], *, near: float, cull: bool
) -> Planes:
    height, width = size
    matrix = torch.from_numpy(camera.world_to_camera()).to(positions.device)
    eye = positions.double() @ matrix[:3, :3].T + matrix[:3, 3]
    focal = height / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    depth = -eye[..., 2]
    corners = torch.stack(
        [width / 2 * depth + focal * eye[..., 0], height / 2 * depth - focal * eye[..., 1], depth], -1
    )
    first, second, third = corners.unbind(1)
    cofactors = torch.stack([second.cross(third, -1), third.cross(first, -1), first.cross(second, -1)], -1)
    determinant = (first * cofactors[..., 0]).sum(-1)
    box, touches = _pixel_box(corners, size, near)
    scale = corners.abs().amax((1, 2)) ** 3
    facing = -determinant if cull else determinant.abs()
    keep = (touches & (facing > 1e-14 * scale) & torch.isfinite(determinant)).nonzero()[:, 0]
    edges = cofactors[keep] / determinant[keep, None, None]
    return Planes(keep, edges.float(), box[keep])


def _pixel_box(
    corners: Float[Tensor, "faces 3 3"], size: tuple[int, int], near: float
) -> tuple[Int[Tensor, "faces 4"], Bool[Tensor, " faces"]]:
    """(Bounding box of each triangle within image and margin, whether it is not empty).

    For triangles that reach behind the camera the box is the whole image.
    """
    height, width = size
    depth = corners[..., 2]
    points = corners[..., :2] / depth.clamp(min=near)[..., None]
    limit = torch.tensor([width, height], device=corners.device)
    low, high = points.amin(1), points.amax(1)
    behind = (depth < near).any(1)
    first, last = torch.full_like(low, -MARGIN), limit - 1.0 + MARGIN
    low = torch.where(behind[:, None], first, low.maximum(first)).floor()
    high = torch.where(behind[:, None], last, high.minimum(last)).floor()
    touches = (high >= low).all(1) & (depth >= near).any(1)
    return torch.cat([low, high], 1).nan_to_num(0.0).long(), touches


Samples = tuple[tuple[float, float], ...]
Drawn = Callable[[Int[Tensor, " n"], Int[Tensor, " n"], Int[Tensor, " n"]], Bool[Tensor, " n"]]
"""Whether triangles (rows of the planes) are drawn at the pixels (x, y)."""


def rasterize(
    planes: Planes,
    size: tuple[int, int],
    samples: Samples,
    *,
    drawn: Drawn | None = None,
    blended: Bool[Tensor, " n"] | None = None,
) -> Visibility:
    """The nearest triangle at each of ``samples`` (x, y in pixels) of every pixel; the first triangle wins ties.

    drawn: test for triangles with holes. blended: the triangles that do not hide others; the nearest ``LAYERS`` of them
    in front of the nearest other one are found. Samples may lie up to a pixel outside of their own.
    """
    planes = replace(planes, box=_candidates(planes.box, size, samples))
    if blended is None:
        nearest = _nearest(planes, size, samples, drawn)
    else:
        nearest = torch.cat(_peeled(planes, size, samples, drawn, blended), 1)
    pixel = (nearest >= 0).any(1).nonzero()[:, 0]
    keys = nearest.index_select(0, pixel)
    row = torch.where(keys >= 0, 0xFFFFFFFF - (keys & 0xFFFFFFFF), -1)
    return Visibility(planes, pixel, row)


def _peeled(
    planes: Planes, size: tuple[int, int], samples: Samples, drawn: Drawn | None, blended: Bool[Tensor, " n"]
) -> list[Int[Tensor, "pixels samples"]]:
    """Keys of the blended layers, front first, and of the opaque triangles, by depth peeling.

    A layer lies clearly behind the one before, by more than ``TIE``: neighbours that meet at a sample count once.
    """
    nothing = torch.tensor([0, 0, -1, -1], device=planes.box.device)
    opaque, through = (
        replace(planes, box=torch.where(kept[:, None], planes.box, nothing)) for kept in (~blended, blended)
    )
    solid = _nearest(opaque, size, samples, drawn)
    layers: list[Tensor] = []
    front = torch.full_like(solid, torch.iinfo(torch.int64).max)
    while len(layers) < LAYERS:
        between = ((solid + (2 * TIE << 32)).flatten(), (front - (2 * TIE << 32)).flatten())
        front = _nearest(through, size, samples, drawn, between)
        if not (front >= 0).any():
            break
        layers.append(front)
    return [*layers, solid]


Between = tuple[Int[Tensor, " pixels_samples"], Int[Tensor, " pixels_samples"]]
"""Keys of ``_nearest`` that limit the depth at each sample: the farthest and the nearest, both excluded."""


def _nearest(
    planes: Planes, size: tuple[int, int], samples: Samples, drawn: Drawn | None, between: Between | None = None
) -> Int[Tensor, "pixels samples"]:
    """Key of the nearest triangle at each sample; -1 for none.

    A key is the float bits of 1/depth (monotone for positive values) without those of ``TIE``, above the inverted
    triangle number.
    """
    height, width = size
    nearest = torch.full((height * width * len(samples),), -1, dtype=torch.int64, device=planes.face.device)
    extent = (planes.box[:, 2:] - planes.box[:, :2] + 1).clamp(min=0)
    coefficients = planes.edges.flatten(1).T.contiguous()

    def draw(start: int, stop: int) -> None:
        """Test triangles ``start:stop`` against the pixels that they may cover."""
        row, x, y = _reached(planes.box[start:stop], _bounds(planes.edges[start:stop], size, samples))
        row += start
        if drawn is not None:
            row, x, y = (values[drawn(row, x, y)] for values in (row, x, y))
        across, down, constant = coefficients.index_select(1, row).view(3, 3, -1)
        at_corner = across * x + down * y + constant
        base = (y * width + x) * len(samples)
        for index, (sx, sy) in enumerate(samples):
            value = at_corner + across * sx + down * sy
            inverse_depth = value.sum(0)
            seen = _inside(value, inverse_depth, planes.near).nonzero()[:, 0]
            bits = inverse_depth.index_select(0, seen).view(torch.int32).long() & ~TIE
            keys = (bits << 32) | (0xFFFFFFFF - row.index_select(0, seen))
            place = base.index_select(0, seen) + index
            if between is not None:
                inside = (keys > between[0][place]) & (keys < between[1][place])
                keys, place = keys[inside], place[inside]
            nearest.scatter_reduce_(0, place, keys, "amax")

    for run in chunks(extent[:, 0] * extent[:, 1]):
        draw(*run)
    return nearest.view(-1, len(samples))


def _bounds(
    edges: Float[Tensor, "n 3 3"], size: tuple[int, int], samples: Samples
) -> Float[Tensor, "coefficients corners n"]:
    """Linear functions of the pixel that are negative only where a corner's barycentric is negative at all samples."""
    edges = edges.double().permute(1, 2, 0)
    most = torch.stack([edges[0] * sx + edges[1] * sy for sx, sy in samples]).amax(0)
    side = torch.tensor([size[1] + 2 * MARGIN, size[0] + 2 * MARGIN, 1], device=edges.device)
    rounding = (edges.abs() * side[:, None, None]).sum(0) * ROUNDING
    return torch.stack([edges[0], edges[1], edges[2] + most + rounding])


def _reached(
    box: Int[Tensor, "n 4"], bounds: Float[Tensor, "coefficients corners n"]
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Triangles with the pixels (x, y) of their boxes where none of their ``bounds`` is negative: a span of each row.

    The box of a long diagonal triangle has ten times as many pixels.
    """
    first, top, last, bottom = box.unbind(1)
    owner, line = numbered(torch.where(last >= first, bottom - top + 1, 0).clamp(min=0))
    y = top.index_select(0, owner) + line
    across, down, constant = bounds.flatten(0, 1).index_select(1, owner).view(3, 3, -1)
    rest = down * y + constant
    crossing = -rest / across
    left = torch.where(across > 0, crossing, -math.inf).amax(0).ceil().maximum(first.index_select(0, owner))
    right = torch.where(across < 0, crossing, math.inf).amin(0).floor().minimum(last.index_select(0, owner))
    none = ((across == 0) & (rest < 0)).any(0)
    counts = torch.where(none, 0, right - left + 1).clamp(min=0).nan_to_num(0.0).long()
    place, within = numbered(counts)
    return owner.index_select(0, place), left.long().index_select(0, place) + within, y.index_select(0, place)


def _candidates(box: Int[Tensor, "n 4"], size: tuple[int, int], samples: Samples) -> Int[Tensor, "n 4"]:
    """Box of the image's pixels with a sample in ``box``; empty if it ends before it begins."""
    height, width = size
    most, least = ([math.floor(choose(axis)) for axis in zip(*samples, strict=True)] for choose in (max, min))
    moved = box - torch.tensor([*most, *least], device=box.device)
    first, last = moved[:, :2].clamp(min=0), moved[:, 2:]
    return torch.cat([first, torch.minimum(last, torch.tensor([width - 1, height - 1], device=box.device))], 1)


def chunks(counts: Int[Tensor, " n"]) -> list[tuple[int, int]]:
    """Runs of items with at most ``MAX_CANDIDATES`` candidates together; a larger item is a run of its own."""
    if not len(counts):
        return []
    total = counts.cumsum(0)
    bounds = [0]
    while bounds[-1] < len(counts):
        done = int(total[bounds[-1] - 1]) if bounds[-1] else 0
        end = int(torch.searchsorted(total, done + MAX_CANDIDATES, right=True))
        bounds.append(max(end, bounds[-1] + 1))
    return list(itertools.pairwise(bounds))


def numbered(counts: Int[Tensor, " n"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """(Item, number within the item) of all candidates, ``counts`` of each item."""
    item = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    start = (counts.cumsum(0) - counts).index_select(0, item)
    return item, torch.arange(len(item), device=counts.device) - start


def covered(
    planes: Planes, row: Int[Tensor, " n"], x: Int[Tensor, " n"], y: Int[Tensor, " n"], samples: Samples
) -> Bool[Tensor, "n samples"]:
    """Whether triangles cover each sample of the pixels (x, y)."""
    edges = planes.edges[row]
    values = [edges[:, 0] * (x + sx)[:, None] + edges[:, 1] * (y + sy)[:, None] + edges[:, 2] for sx, sy in samples]
    return torch.stack([_inside(value.T, value.sum(1), planes.near) for value in values], 1)


def _inside(over_depth: Float[Tensor, "3 n"], inverse_depth: Float[Tensor, " n"], near: float) -> Bool[Tensor, " n"]:
    return (over_depth >= 0).all(0) & (inverse_depth > 0) & (inverse_depth < 1 / near)
