"""Which triangle does each sub-sample of each pixel see, and where on it? Computed once per view, never again.

Triangles are rasterised in homogeneous coordinates (Olano and Greer, 1997): the perspective-correct barycentrics
divided by depth are *linear* functions of the pixel position, so no clipping is needed, a camera may stand inside the
object, and UVs and their screen-space derivatives are exact anywhere on (and beyond) a triangle.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from trompe_shared.geometry import FIELD_OF_VIEW, Camera
from trompe_shared.object3d import Object3D
from trompe_shared.opacity import opacity_of

__all__ = [
    "CENTRE",
    "MSAA4",
    "MSAA4_MIRRORED",
    "Drawn",
    "Mesh",
    "Planes",
    "Visibility",
    "chunks",
    "covered",
    "mesh_of",
    "project",
    "rasterize",
]

CENTRE = ((0.5, 0.5),)
"""One sample in the middle of a pixel."""

MSAA4 = ((0.375, 0.125), (0.875, 0.375), (0.125, 0.625), (0.625, 0.875))
"""The standard sample positions of 4x MSAA (x right, y down, in pixels), common to Direct3D, Vulkan and OpenGL drivers.
"""

MSAA4_MIRRORED = tuple((x, 1 - y) for x, y in MSAA4)
"""The same for renderers that count rows from the bottom (OpenGL): the pattern in the image is upside down."""

NEAR = 1e-3
"""Nothing nearer to the camera than this is seen, metres."""

FACES_AT_ONCE = 2**14
"""Triangles that are set up at once: what that takes stays in the processor's cache."""

MAX_CANDIDATES = 2_000_000
"""Pixel-triangle pairs that are tested at once: bounds the memory of the rasteriser (about 200 bytes each)."""

TIE = 2**6 - 1
"""Last bits of 1/depth in which triangles may differ and count as equally near: those of one plane, whose depths differ
by rounding alone. That is 3 to 6 micrometres at half a metre, which depth buffers do not tell apart either.
"""

MARGIN = 1
"""Pixels around the image where triangles are kept, for samples that lie up to a pixel outside of theirs."""


@dataclass(frozen=True)
class Mesh:
    """All triangles of an object.

    positions: metres. uvs: v = 0 is the bottom row. normals: unit length. texture: index into ``textures``, the albedo
    file names. opacities: the alpha of those textures that cut something out, in [0, 1], by their index.
    """

    positions: Float[Tensor, "faces 3 3"]
    uvs: Float[Tensor, "faces 3 2"]
    normals: Float[Tensor, "faces 3 3"]
    texture: Int[Tensor, " faces"]
    textures: tuple[str, ...]
    opacities: Mapping[int, Float[Tensor, "H W"]] = field(default_factory=dict)


def mesh_of(obj: Object3D, *, device: torch.device | str = "cpu") -> Mesh:
    """The triangles of ``obj``, in the order of its parts."""
    names = tuple(sorted(obj.textures))
    gathered: dict[str, list[Tensor]] = {"positions": [], "uvs": [], "normals": [], "texture": []}
    for part in obj.parts:
        faces = torch.from_numpy(part.faces).long()
        gathered["positions"].append(torch.from_numpy(part.vertices)[faces])
        gathered["uvs"].append(torch.from_numpy(part.uvs)[faces])
        gathered["normals"].append(torch.from_numpy(part.normals)[faces])
        gathered["texture"].append(torch.full((len(faces),), names.index(obj.albedo_of(part)), device="cpu"))
    found = {number: opacity_of(obj.files[name]) for number, name in enumerate(names)}
    opacities = {k: torch.from_numpy(alpha).to(device) / 255 for k, alpha in found.items() if alpha is not None}
    arrays = {key: torch.cat(value).to(device) for key, value in gathered.items()}
    return Mesh(**arrays, textures=names, opacities=opacities)


@dataclass(frozen=True)
class Planes:
    """The triangles that can be seen in one view, as linear functions ``a x + b y + c`` of the pixel position.

    face: index into the mesh. edges: barycentric of each corner over depth. box: first and last pixel column and row.
    """

    face: Int[Tensor, " n"]
    edges: Float[Tensor, "n 3 3"]  # (triangle, coefficient a/b/c, corner)
    box: Int[Tensor, "n 4"]  # x0, y0, x1, y1, inclusive


@dataclass(frozen=True)
class Visibility:
    """What the sub-samples of one view see: ``planes`` row per (pixel, sample), -1 where they see nothing.

    Only pixels with a sample that sees something are kept; ``pixel`` is row * W + column.
    """

    planes: Planes
    pixel: Int[Tensor, " p"]
    row: Int[Tensor, "p samples"]


def project(mesh: Mesh, camera: Camera, size: tuple[int, int], *, cull: bool) -> Planes:
    """Set up the triangles of ``mesh`` for ``camera`` and an image of ``size`` (H, W).

    With ``cull`` triangles seen from behind (clockwise) are dropped. Degenerate ones always are.
    """
    parts = [_set_up(faces, camera, size, cull=cull) for faces in torch.split(mesh.positions, FACES_AT_ONCE)]
    kept = [part.face + k * FACES_AT_ONCE for k, part in enumerate(parts)]
    return Planes(torch.cat(kept), torch.cat([part.edges for part in parts]), torch.cat([part.box for part in parts]))


def _set_up(positions: Float[Tensor, "faces 3 3"], camera: Camera, size: tuple[int, int], *, cull: bool) -> Planes:
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
    box, touches = _pixel_box(corners, size)
    scale = corners.abs().amax((1, 2)) ** 3
    facing = -determinant if cull else determinant.abs()
    keep = (touches & (facing > 1e-14 * scale) & torch.isfinite(determinant)).nonzero()[:, 0]
    edges = cofactors[keep] / determinant[keep, None, None]
    return Planes(keep, edges.float(), box[keep])


def _pixel_box(
    corners: Float[Tensor, "faces 3 3"], size: tuple[int, int]
) -> tuple[Int[Tensor, "faces 4"], Bool[Tensor, " faces"]]:
    """Pixels of the image and its margin that each triangle can touch, and whether there are any; all of them where it
    reaches behind the camera."""
    height, width = size
    depth = corners[..., 2]
    points = corners[..., :2] / depth.clamp(min=NEAR)[..., None]
    limit = torch.tensor([width, height], device=corners.device)
    low, high = points.amin(1), points.amax(1)
    behind = (depth < NEAR).any(1)
    first, last = torch.full_like(low, -MARGIN), limit - 1.0 + MARGIN
    low = torch.where(behind[:, None], first, low.maximum(first)).floor()
    high = torch.where(behind[:, None], last, high.minimum(last)).floor()
    touches = (high >= low).all(1) & (depth >= NEAR).any(1)
    return torch.cat([low, high], 1).nan_to_num(0.0).long(), touches


Samples = tuple[tuple[float, float], ...]
Drawn = Callable[[Int[Tensor, " n"], Int[Tensor, " n"], Int[Tensor, " n"]], Bool[Tensor, " n"]]
"""Whether triangles (rows of the planes) are drawn at the pixels (x, y)."""


def rasterize(planes: Planes, size: tuple[int, int], samples: Samples, *, drawn: Drawn | None = None) -> Visibility:
    """The nearest triangle at each of ``samples`` (x, y in pixels) of every pixel. The first one drawn wins ties.

    Triangles are left out of the pixels where they are not ``drawn``. Samples may lie up to a pixel outside of theirs.
    """
    height, width = size
    planes = replace(planes, box=_candidates(planes.box, size, samples))
    nearest = torch.full((height * width * len(samples),), -1, dtype=torch.int64, device=planes.face.device)
    extent = (planes.box[:, 2:] - planes.box[:, :2] + 1).clamp(min=0)
    counts = extent[:, 0] * extent[:, 1]
    for start, stop in chunks(counts):
        _draw(planes, start, stop, counts, width, samples, drawn, nearest)
    nearest = nearest.view(-1, len(samples))
    pixel = (nearest >= 0).any(1).nonzero()[:, 0]
    keys = nearest[pixel]
    row = torch.where(keys >= 0, 0xFFFFFFFF - (keys & 0xFFFFFFFF), -1)
    return Visibility(planes, pixel, row)


def _candidates(box: Int[Tensor, "n 4"], size: tuple[int, int], samples: Samples) -> Int[Tensor, "n 4"]:
    """The pixels of the image with a sample in ``box``, as a box (empty where its end lies before its beginning)."""
    height, width = size
    most, least = ([math.floor(choose(axis)) for axis in zip(*samples, strict=True)] for choose in (max, min))
    moved = box - torch.tensor([*most, *least], device=box.device)
    first, last = moved[:, :2].clamp(min=0), moved[:, 2:]
    return torch.cat([first, torch.minimum(last, torch.tensor([width - 1, height - 1], device=box.device))], 1)


def chunks(counts: Int[Tensor, " n"]) -> list[tuple[int, int]]:
    """Runs of things whose candidates fit into ``MAX_CANDIDATES`` (a single larger one is a run of its own)."""
    if not len(counts):
        return []
    total = counts.cumsum(0)
    bounds = [0]
    while bounds[-1] < len(counts):
        done = int(total[bounds[-1] - 1]) if bounds[-1] else 0
        end = int(torch.searchsorted(total, done + MAX_CANDIDATES, right=True))
        bounds.append(max(end, bounds[-1] + 1))
    return list(itertools.pairwise(bounds))


def _draw(
    planes: Planes,
    start: int,
    stop: int,
    counts: Int[Tensor, " n"],
    width: int,
    samples: Samples,
    drawn: Drawn | None,
    nearest: Int[Tensor, " pixels_samples"],
) -> None:
    """Test triangles ``start:stop`` against the pixels of their boxes and keep the nearest per sample, in ``nearest``.

    A key is the float bits of 1/depth (monotone, as it is positive), less those that ``TIE`` has, above the inverted
    triangle number.
    """
    row = torch.arange(start, stop, device=counts.device).repeat_interleave(counts[start:stop])
    within = (
        torch.arange(len(row), device=row.device) - (counts[start:stop].cumsum(0) - counts[start:stop])[row - start]
    )
    box = planes.box[row]
    columns = box[:, 2] - box[:, 0] + 1
    x, y = box[:, 0] + within % columns, box[:, 1] + within // columns
    if drawn is not None:
        row, x, y = (values[drawn(row, x, y)] for values in (row, x, y))
    edges = planes.edges[row]
    at_corner = edges[:, 0] * x[:, None] + edges[:, 1] * y[:, None] + edges[:, 2]
    base = (y * width + x) * len(samples)
    for index, (sx, sy) in enumerate(samples):
        value = at_corner + edges[:, 0] * sx + edges[:, 1] * sy
        inverse_depth = value.sum(1)
        seen = _inside(value, inverse_depth).nonzero()[:, 0]
        bits = inverse_depth[seen].contiguous().view(torch.int32).long() & ~TIE
        keys = (bits << 32) | (0xFFFFFFFF - row[seen])
        nearest.scatter_reduce_(0, base[seen] + index, keys, "amax")


def covered(
    planes: Planes, row: Int[Tensor, " n"], x: Int[Tensor, " n"], y: Int[Tensor, " n"], samples: Samples
) -> Bool[Tensor, "n samples"]:
    """Which samples of the pixels (x, y) triangles cover."""
    edges = planes.edges[row]
    values = [edges[:, 0] * (x + sx)[:, None] + edges[:, 1] * (y + sy)[:, None] + edges[:, 2] for sx, sy in samples]
    return torch.stack([_inside(value, value.sum(1)) for value in values], 1)


def _inside(over_depth: Float[Tensor, "n 3"], inverse_depth: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    return (over_depth >= 0).all(1) & (inverse_depth > 0) & (inverse_depth < 1 / NEAR)
