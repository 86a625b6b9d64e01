"""Surfaces: patches that know where they lie in space, how large they are when unrolled, and how they are painted.

A patch is seen from outside with s to the right and t up, both in metres, so that s x t is the outward normal.
Objects are built from revolved profiles, caps, swept tubes and bevelled boxes. World: y up, metres, +z is the front.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trompe_renderer.check.probes import FACES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Warp = Callable[[Array], Array]


@dataclass(frozen=True)
class Texels:
    """The texels of one patch that are to be painted.

    s, t:      (H, W) metres from the patch's left and lower edge.
    size:      (width, height) of the patch, metres.
    position:  (H, W, 3) metres.
    pitch:     metres from one texel to the next: how sharp an edge may be.
    """

    s: Array
    t: Array
    size: tuple[float, float]
    position: Array
    pitch: float


@dataclass(frozen=True)
class Coat:
    """What a brush leaves on texels: sRGB colour (H, W, 3) in [0, 1], relief in metres, and two scalars in [0, 1]."""

    colour: Array
    height: Array | float = 0.0
    metallic: Array | float = 0.0
    smoothness: Array | float = 0.3


Paint = Callable[[Texels], Coat]


@dataclass(frozen=True)
class Patch:
    """A piece of surface with its own rectangle in the texture.

    points: (V, 3) metres; plane: (V, 2) metres, the patch unrolled; faces: (F, 3), counter-clockwise seen from outside.
    ``locate`` gives the points (..., 3) at unrolled coordinates (s, t). ``density`` scales its share of texels.
    """

    points: Array
    plane: Array
    faces: NDArray[np.int64]
    size: tuple[float, float]
    locate: Callable[[Array, Array], Array]
    paint: Paint
    density: float = 1.0


Materials = Mapping[str, Sequence[Patch]]
"""Patches by the name of their material."""


def curve(control: ArrayLike, samples: int) -> Array:
    """``samples`` points, evenly spaced in arc length, of the Catmull-Rom spline through ``control`` (K, D)."""
    knots = np.asarray(control, dtype=np.float64)
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    x = np.linspace(0, len(knots) - 1, 40 * len(knots))
    i = np.minimum(x.astype(int), len(knots) - 2)
    f = (x - i)[:, None]
    a, b, c, d = (padded[i + k] for k in range(4))
    fine = 0.5 * (2 * b + (c - a) * f + (2 * a - 5 * b + 4 * c - d) * f**2 + (3 * b - a - 3 * c + d) * f**3)
    length = _lengths(fine)
    even = np.linspace(0, length[-1], samples)
    return np.stack([np.interp(even, length, fine[:, k]) for k in range(knots.shape[1])], axis=1)


def _lengths(points: Array) -> Array:
    """Arc length (K,) from the first point to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])


def sheet(points: Array, paint: Paint, *, density: float = 1.0) -> Patch:
    """A patch through a grid of points (R, C, 3): columns run along s, rows along t."""
    rows, columns = points.shape[:2]
    s = np.mean([_lengths(points[r]) for r in range(rows)], axis=0)
    t = np.mean([_lengths(points[:, c]) for c in range(columns)], axis=0)
    plane = np.stack(np.meshgrid(s, t), axis=-1)

    def locate(at_s: Array, at_t: Array) -> Array:
        x, y = np.interp(at_s, s, np.arange(columns)), np.interp(at_t, t, np.arange(rows))
        i, j = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
        f, g = (x - i)[..., None], (y - j)[..., None]
        lower = points[j, i] * (1 - f) + points[j, i + 1] * f
        upper = points[j + 1, i] * (1 - f) + points[j + 1, i + 1] * f
        return np.asarray(lower * (1 - g) + upper * g)

    faces = _grid_faces(rows, columns)
    return Patch(
        points.reshape(-1, 3), plane.reshape(-1, 2), faces, (float(s[-1]), float(t[-1])), locate, paint, density
    )


def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
    upper = np.stack([corner, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([lower, upper])


def _circle(segments: int, arc: tuple[float, float] = (-180.0, 180.0)) -> Array:
    """(sin, cos) of azimuths over an arc in degrees, (segments + 1, 2)."""
    angle = np.radians(np.linspace(*arc, segments + 1))
    return np.round(np.stack([np.sin(angle), np.cos(angle)], axis=1), 12)


def revolve(
    profile: ArrayLike,
    paint: Paint,
    *,
    segments: int = 32,
    arc: tuple[float, float] = (-180.0, 180.0),
    density: float = 1.0,
) -> Patch:
    """Surface of revolution about y of a profile (K, 2) of (radius, height); the front (+z) is the middle of s.

    A profile runs from the bottom up on the outside and down on the inside. ``arc`` is the range of azimuths, degrees.
    """
    line, circle = np.asarray(profile, dtype=np.float64), _circle(segments, arc)
    points = np.empty((len(line), segments + 1, 3))
    points[..., 0] = line[:, :1] * circle[:, 0]
    points[..., 1] = line[:, 1:]
    points[..., 2] = line[:, :1] * circle[:, 1]
    return sheet(points, paint, density=density)


def cap(profile: ArrayLike, paint: Paint, *, segments: int = 32, density: float = 1.0) -> Patch:
    """The part of a surface of revolution that reaches the axis, unrolled flat around the pole.

    The pole is the first point of the profile (K, 2) (a bottom) or its last (a top).
    """
    line = np.asarray(profile, dtype=np.float64)
    top = line[-1, 0] == 0
    outward = line[::-1] if top else line
    reach, side = _lengths(outward), -1.0 if top else 1.0
    circle = _circle(segments)[:-1]
    rings = [np.column_stack([r * circle[:, 0], np.full(segments, y), r * circle[:, 1]]) for r, y in outward[1:]]
    points = np.concatenate([[[0.0, outward[0, 1], 0.0]], *rings])
    plane = np.concatenate([[[0.0, 0.0]], *(rho * circle * [1.0, side] for rho in reach[1:])]) + reach[-1]

    def locate(s: Array, t: Array) -> Array:
        x, z = s - reach[-1], side * (t - reach[-1])
        rho = np.maximum(np.hypot(x, z), 1e-12)
        radius = np.interp(rho, reach, outward[:, 0]) / rho
        return np.stack([radius * x, np.interp(rho, reach, outward[:, 1]), radius * z], axis=-1)

    side_length = 2 * float(reach[-1])
    return Patch(
        points, plane, _cap_faces(len(line) - 1, segments, top), (side_length, side_length), locate, paint, density
    )


def _cap_faces(rings: int, segments: int, top: bool) -> NDArray[np.int64]:
    this, following = np.arange(segments), (np.arange(segments) + 1) % segments
    fan = np.stack([np.zeros(segments, dtype=int), this + 1, following + 1], axis=1)
    faces = [fan]
    for ring in range(rings - 1):
        inner, outer = 1 + ring * segments, 1 + (ring + 1) * segments
        faces.append(np.stack([inner + this, outer + this, outer + following], axis=1))
        faces.append(np.stack([inner + this, outer + following, inner + following], axis=1))
    merged = np.concatenate(faces)
    return merged if top else merged[:, ::-1]


def tube(
    path: Array, radii: ArrayLike, paint: Paint, *, up: Sequence[float], sides: int = 12, density: float = 1.0
) -> Patch:
    """A tube swept along ``path`` (K, 3). ``radii`` is (K, 2) or broadcastable: across ``up`` and along it."""
    forward = np.gradient(path, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    across = np.cross(np.asarray(up, dtype=np.float64), forward)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    over = np.cross(forward, across)
    r = np.broadcast_to(np.asarray(radii, dtype=np.float64), (len(path), 2))
    circle = _circle(sides)
    offset = circle[:, 1, None] * (across * r[:, :1])[:, None] + circle[:, 0, None] * (over * r[:, 1:])[:, None]
    return sheet(path[:, None] + offset, paint, density=density)


def bevelled_box(
    size: Sequence[float],
    paint: Paint,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    bevel: float,
    cuts: Sequence[int] = (1, 1, 1),
    warp: Warp | None = None,
) -> dict[str, Patch]:
    """The six faces of a box with chamfered edges, by name; each face reaches to the middle of its chamfers.

    ``cuts`` divides each axis, so that ``warp``, a map of points (..., 3) applied last, can taper or bend the box.
    """
    half = np.asarray(size, dtype=np.float64) / 2
    faces = {}
    for name, (normal, upwards, _) in FACES.items():
        out, up = (np.asarray(axis, dtype=np.float64) for axis in (normal, upwards))
        right = np.cross(up, out)
        s, t = (_knots(float(abs(axis) @ half), bevel, int(abs(axis) @ np.asarray(cuts))) for axis in (right, up))
        grid = s[None, :, None] * right + t[:, None, None] * up + float(abs(out) @ half) * out
        edge = (
            np.isin(np.arange(len(s)), [0, len(s) - 1])[None, :],
            np.isin(np.arange(len(t)), [0, len(t) - 1])[:, None],
        )
        folded = (edge[0].astype(float) + edge[1]).astype(bool)[..., None]
        corner = (edge[0] & edge[1])[..., None]
        points = grid - out * bevel * np.where(corner, 2 / 3, np.where(folded, 0.5, 0.0))
        points = _pull_in(points, right, edge[0], corner, bevel)
        points = _pull_in(points, up, edge[1], corner, bevel) + np.asarray(centre, dtype=np.float64)
        faces[name] = sheet(points if warp is None else warp(points), paint)
    return faces


def _pull_in(points: Array, axis: Array, edge: Mask, corner: Mask, bevel: float) -> Array:
    """Move the outermost points of a face inwards along ``axis`` to the middle of the chamfer."""
    along = np.sign(points @ axis)[..., None] * axis
    amount = np.where(corner, 2 / 3, np.where(edge[..., None], 0.5, 0.0))
    return np.asarray(points - along * bevel * amount)


def _knots(half: float, bevel: float, cuts: int) -> Array:
    return np.concatenate([[-half], np.linspace(bevel - half, half - bevel, cuts + 1), [half]])


def moved(patch: Patch, warp: Warp) -> Patch:
    """The same patch elsewhere: ``warp`` maps points (..., 3), and must not mirror."""
    return replace(patch, points=warp(patch.points), locate=lambda s, t: warp(patch.locate(s, t)))
