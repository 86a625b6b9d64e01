"""Ball and book."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from objects.brushes import clouds, cover, letters, mix, noise, rgb, smooth, star
from objects.mesh import Array, Coat, Materials, Paint, Patch, Texels, bevelled_box, sheet

# --- ball ---

_RADIUS = 0.11
_GOLDEN = (1 + 5**0.5) / 2


def _tilt() -> Array:
    """A rotation that shows a pentagon off-centre rather than a pole."""
    a, b = 0.55, 0.30
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return np.asarray(about_x @ about_y)


def _directions(seeds: Sequence[Sequence[float]]) -> Array:
    """Unit vectors (N, 3): all even permutations and signs of the seeds."""
    found = set()
    for seed in seeds:
        for signs in np.ndindex(2, 2, 2):
            for roll in range(3):
                vector = np.roll(np.where(np.array(signs) == 1, -1, 1) * np.array(seed), roll)
                found.add(tuple(np.round(vector / np.linalg.norm(vector), 12) + 0.0))
    return np.array(sorted(found)) @ _tilt().T


_PENTAGONS = _directions([(0, 1, _GOLDEN)])
_HEXAGONS = _directions([(1, 1, 1), (0, _GOLDEN, 1 / _GOLDEN)])


def _leather(texels: Texels) -> Coat:
    """A football: navy pentagons with an orange star, cream hexagons, sunk seams with stitches, some scuffs."""
    direction = texels.position / np.linalg.norm(texels.position, axis=-1, keepdims=True)
    five, six = direction @ _PENTAGONS.T, direction @ _HEXAGONS.T
    # The planes of a truncated icosahedron's faces: a point belongs to the face whose plane it meets first.
    reach = np.sort(np.concatenate([five * 1.0 / 0.93929, six * 1.0 / 0.91496], axis=-1), axis=-1)
    seam = (reach[..., -1] - reach[..., -2]) * _RADIUS * 1.45
    pentagon = (five.max(axis=-1) / 0.93929 > six.max(axis=-1) / 0.91496).astype(float)
    grain = noise(direction * 75, seed=401)
    hexagon = mix(rgb("f2ecdd"), rgb("ddd3bc"), clouds(direction * 9, seed=403))
    ring = cover(np.abs(np.arccos(np.clip(six.max(axis=-1), -1, 1)) * _RADIUS - 0.0165) - 0.0022, texels.pitch)
    hexagon = mix(hexagon, rgb("d9742b"), ring)
    navy = mix(rgb("1c2b5e"), rgb("2c4388"), clouds(direction * 14, seed=405))
    colour = mix(hexagon, _starred(navy, direction, five, texels.pitch), pentagon)
    scuff = smooth(0.62, 0.8, clouds(direction * [3, 22, 5], seed=411)) * 0.35
    colour = mix(colour, rgb("8c7a5a"), scuff)
    groove = np.exp(-((seam / 0.0022) ** 2))
    colour = mix(colour, rgb("2b2620"), 0.85 * groove)
    return Coat(colour, height=0.0002 * grain - 0.0022 * groove, smoothness=0.48 - 0.25 * groove)


def _starred(colour: Array, direction: Array, cosines: Array, pitch: float) -> Array:
    """A five-pointed star in the middle of each pentagon."""
    nearest = _PENTAGONS[cosines.argmax(axis=-1)]
    helper = np.where(np.abs(nearest[..., 1:2]) < 0.9, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    right = np.cross(helper, nearest)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.cross(nearest, right)
    x, y = ((direction * axis).sum(axis=-1) * _RADIUS for axis in (right, up))
    shape = star(x / 0.0175, y / 0.0175, points=5, inner=0.45) * 0.0175
    return mix(colour, rgb("f0b13a"), cover(shape, pitch))


def _cube_side(right: Sequence[int], up: Sequence[int], cuts: int) -> Array:
    """One sixth of a sphere as a grid of directions, evenly spaced in angle."""
    angle = np.tan(np.linspace(-np.pi / 4, np.pi / 4, cuts + 1))
    r, u = np.asarray(right, dtype=np.float64), np.asarray(up, dtype=np.float64)
    points = angle[None, :, None] * r + angle[:, None, None] * u + np.cross(r, u)
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))


def ball() -> Materials:
    """A football, 22 cm across."""
    sides = [((1, 0, 0), (0, 1, 0)), ((0, 0, -1), (0, 1, 0)), ((-1, 0, 0), (0, 1, 0)), ((0, 0, 1), (0, 1, 0))]
    sides += [((1, 0, 0), (0, 0, -1)), ((1, 0, 0), (0, 0, 1))]
    return {"ball_leather": [sheet(_RADIUS * _cube_side(right, up, 12), _leather) for right, up in sides]}


# --- book ---

_WIDTH, _HEIGHT, _THICK = 0.155, 0.225, 0.042


def _hide(texels: Texels) -> Coat:
    """Oxblood leather, grained and rubbed at the edges."""
    p = texels.position
    pores = noise(p * 420, seed=501)
    tone = clouds(p * 35, seed=503)
    colour = mix(rgb("6d1a1f"), rgb("94302c"), smooth(0.3, 0.7, tone))
    edge = np.minimum(np.minimum(texels.s, texels.size[0] - texels.s), np.minimum(texels.t, texels.size[1] - texels.t))
    worn = (1 - smooth(0.0, 0.006, edge)) * smooth(0.3, 0.6, noise(p * 120, seed=507))
    colour = mix(colour, rgb("b8714f"), 0.6 * worn)
    return Coat(mix(colour, rgb("4a0f14"), 0.35 * pores), height=0.0003 * pores, smoothness=0.34)


def _gilded(leather: Coat, gold: Array, texels: Texels) -> Coat:
    """Press gold leaf (weights (H, W)) into leather."""
    shine = noise(texels.position * 260, seed=511)
    colour = mix(leather.colour, mix(rgb("c1912f"), rgb("eccf7c"), shine), gold)
    return Coat(colour, np.asarray(leather.height) - 0.0006 * gold, 0.55 * gold, 0.34 + 0.3 * gold)


def _front_cover(texels: Texels) -> Coat:
    """Double frame with corner leaves, a sunburst eye, and the title."""
    x, y = texels.s - texels.size[0] / 2, texels.t - texels.size[1] / 2
    hx, hy = texels.size[0] / 2, texels.size[1] / 2
    inset = np.maximum(np.abs(x) - hx, np.abs(y) - hy)
    shapes = [np.abs(inset + 0.0095) - 0.0013, np.abs(inset + 0.0140) - 0.0006]
    cx, cy = hx - 0.0265 - np.abs(x), hy - 0.0265 - np.abs(y)
    angle, radius = np.arctan2(cy, cx), np.hypot(cx, cy)
    leaf = radius - 0.011 * (0.45 + 0.55 * np.abs(np.sin(2 * angle)))
    shapes.append(np.maximum(leaf, -(radius - 0.0022)))
    v = y + 0.012
    almond = np.maximum(np.hypot(x, v - 0.017), np.hypot(x, v + 0.017)) - 0.034
    shapes.append(np.abs(almond) - 0.0014)
    shapes.append(np.abs(np.hypot(x, v) - 0.0105) - 0.0013)
    shapes.append(np.hypot(x, v) - 0.005)
    turn, far = np.arctan2(x, v), np.hypot(x, v)
    rays = np.abs((turn + np.pi / 24) % (np.pi / 12) - np.pi / 24) * far - 0.0011 * (1.6 - far / 0.04)
    shapes.append(np.maximum(rays, np.abs(far - 0.0405) - 0.0065))
    shapes.append(letters("TROMPE", x, y - 0.064, height=0.0165) - 0.0015)
    shapes.append(letters("L'OEIL", x, y - 0.0425, height=0.0115) - 0.0010)
    shapes.append(letters("ART OF SEEING", x, y + 0.076, height=0.0072) - 0.0007)
    return _gilded(_hide(texels), cover(np.minimum.reduce(shapes), texels.pitch), texels)


def _back_cover(texels: Texels) -> Coat:
    x, y = texels.s - texels.size[0] / 2, texels.t - texels.size[1] / 2
    inset = np.maximum(np.abs(x) - texels.size[0] / 2, np.abs(y) - texels.size[1] / 2)
    emblem = star(x / 0.026, y / 0.026, points=8, inner=0.5) * 0.026
    shape = np.minimum(np.abs(inset + 0.0095) - 0.0013, np.maximum(emblem, -(np.hypot(x, y) - 0.008)))
    return _gilded(_hide(texels), cover(shape, texels.pitch), texels)


def _spine(texels: Texels) -> Coat:
    """Raised bands ruled in gold, a dark title field, the title along the spine."""
    leather, t = _hide(texels), texels.t
    along, across = texels.t - texels.size[1] / 2, texels.s - texels.size[0] / 2
    bands = np.array([0.12, 0.28, 0.72, 0.88]) * texels.size[1]
    off = np.min(np.abs(t[..., None] - bands), axis=-1)
    field = cover(np.abs(along) - 0.21 * texels.size[1] + 0.004, texels.pitch)
    ground = mix(leather.colour, rgb("1f2a24"), field)
    title = letters("TROMPE", -along, across, height=0.017) - 0.0016
    flowers = np.minimum(
        *(star(across / 0.008, (along - k) / 0.008, points=6, inner=0.5) * 0.008 for k in (0.067, -0.067))
    )
    gold = cover(np.minimum.reduce([np.abs(off - 0.0055) - 0.0006, title, flowers]), texels.pitch)
    raised = 0.002 * (1 - smooth(0.001, 0.004, off))
    return _gilded(replace(leather, colour=ground, height=np.asarray(leather.height) + raised), gold, texels)


def _pages(axis: int) -> Paint:
    """Cut edges of paper: fine lines across ``axis`` and a little foxing."""

    def paint(texels: Texels) -> Coat:
        p = texels.position
        sheets = noise(np.stack([p[..., 2] * 900, p[..., axis] * 8, np.zeros_like(texels.s)], axis=-1), seed=521)
        gatherings = np.abs(np.sin(p[..., 2] * np.pi / 0.0052))
        colour = mix(rgb("c9b485"), rgb("f2e6c6"), np.clip(0.75 * sheets + 0.35 * gatherings, 0, 1))
        stain = smooth(0.6, 0.8, clouds(p * 45, seed=525))
        return Coat(mix(colour, rgb("a98a57"), 0.4 * stain), height=0.0004 * sheets, smoothness=0.12)

    return paint


def _rounded(points: Array) -> Array:
    """Bend the fore edge in and the spine out."""
    bent = points.copy()
    bow = 1 - np.clip(np.abs(points[..., 2]) / (_THICK / 2), 0, 1) ** 2
    bent[..., 0] -= 0.011 * bow
    return bent


def book() -> Materials:
    """A leather-bound book standing upright, 22.5 cm high, front cover to the front, spine to the left."""
    board, square = 0.0035, 0.004
    patches = []
    for side, name, paint in ((1, "front", _front_cover), (-1, "back", _back_cover)):
        cover_board = bevelled_box(
            (_WIDTH, _HEIGHT, board), _hide, centre=(0, 0, side * (_THICK / 2 - board / 2)), bevel=0.0012
        )
        cover_board[name] = replace(cover_board[name], paint=paint, density=1.25)
        inner = "back" if side > 0 else "front"
        cover_board[inner] = replace(cover_board[inner], density=0.3)
        patches += list(cover_board.values())
    block = (_WIDTH - square, _HEIGHT - 2 * square, _THICK - 2 * board + 0.0004)
    pages = bevelled_box(block, _pages(1), centre=(-square / 2, 0, 0), bevel=0.0002, cuts=(1, 1, 8), warp=_rounded)
    pages |= {name: replace(pages[name], paint=_pages(0)) for name in ("top", "bottom")}
    patches += [pages[name] for name in ("right", "top", "bottom")]
    patches += _spine_patches(board)
    return {"book_leather": patches}


def _spine_patches(board: float) -> list[Patch]:
    """A rounded back: outside, and its two ends."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 11)
    arcs = [
        (r * np.cos(angle), np.sin(angle) * (_THICK / 2 - d)) for r, d in ((0.0125, 0.0004), (0.0125 - board, board))
    ]
    (outer_x, outer_z), (inner_x, inner_z) = arcs
    heights = np.array([-_HEIGHT / 2, 0.0, _HEIGHT / 2])
    left = 0.0018 - _WIDTH / 2
    back = np.stack([np.stack([left - outer_x, np.full(11, y), outer_z], axis=-1) for y in heights])
    ends = []
    for y, flip in ((_HEIGHT / 2, False), (-_HEIGHT / 2, True)):
        outer = np.stack([left - outer_x, np.full(11, y), outer_z], axis=-1)
        inner = np.stack([left - inner_x, np.full(11, y), inner_z], axis=-1)
        ends.append(np.stack([inner, outer] if flip else [outer, inner]))
    return [sheet(back, _spine, density=1.25), *(sheet(end, _hide) for end in ends)]
