"""Procedural colour and relief: noise, edges, wood, weave, and letters drawn with strokes.

All randomness is a hash of integer lattice points and a seed, so that it is the same on every machine.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from objects.mesh import Array, Coat, Paint, Texels


def rgb(code: str) -> Array:
    """sRGB colour (3,) in [0, 1] of a code like ``"a0c4ff"``."""
    return np.array([int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)])


def mix(below: Array, above: Array, weight: Array | float) -> Array:
    """``above`` over ``below``, colours (..., 3), with ``weight`` (...) in [0, 1]."""
    w = np.asarray(weight)[..., None]
    return np.asarray(below * (1 - w) + above * w)


def smooth(low: float, high: float, x: Array) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    f = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(f * f * (3 - 2 * f))


def cover(distance: Array, pitch: float) -> Array:
    """How much of a texel lies inside a shape: ``distance`` is signed (inside negative), both in metres."""
    return np.clip(0.5 - distance / pitch, 0, 1)


def noise(points: Array, seed: int) -> Array:
    """Smooth noise in [0, 1] at points (..., 3) with one lattice cell per unit."""
    cell = np.floor(points).astype(np.int64)
    f = points - cell
    f = f * f * f * (f * (f * 6 - 15) + 10)
    total = np.zeros(points.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, f, 1 - f), axis=-1)
        total += weight * _hash(cell + np.array(corner), seed)
    return total


def _hash(cell: NDArray[np.int64], seed: int) -> Array:
    """A number in [0, 1) for each integer point (..., 3)."""
    with np.errstate(over="ignore"):
        x = cell.astype(np.uint64) * np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], dtype=np.uint64)
        h = x[..., 0] ^ (x[..., 1] << np.uint64(7)) ^ (x[..., 2] << np.uint64(13)) ^ np.uint64(seed * 0x27D4EB2F)
        for _ in range(2):
            h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        h ^= h >> np.uint64(32)
    return np.asarray((h >> np.uint64(11)).astype(np.float64) / 2.0**53)


def clouds(points: Array, seed: int, *, octaves: int = 4) -> Array:
    """Sum of noises of doubling frequency and halving weight, in [0, 1]."""
    total, weight = np.zeros(points.shape[:-1]), 0.0
    for octave in range(octaves):
        total += noise(points * 2.0**octave, seed + octave) / 2.0**octave
        weight += 1 / 2.0**octave
    return total / weight


def wood(
    *,
    light: str,
    dark: str,
    along: int,
    ring: float,
    seed: int,
    smoothness: float = 0.45,
) -> Paint:
    """Solid wood with grain along axis ``along`` and year rings ``ring`` metres apart around a far-off heart."""

    def paint(texels: Texels) -> Coat:
        p = np.roll(texels.position, -along, axis=-1) / ring
        wander = clouds(p * [0.03, 0.12, 0.12], seed, octaves=3) - 0.5
        heart = np.hypot(p[..., 1] + 0.31 / ring, p[..., 2] + 0.17 / ring)
        rings = (heart + 3.5 * wander) % 1.0
        late = smooth(0.35, 0.9, rings) * (1 - smooth(0.92, 1.0, rings))
        fibre = noise(p * [0.12, 2.2, 2.2], seed + 9)
        tone = 0.55 * late + 0.3 * fibre + 0.5 * wander
        colour = mix(rgb(light), rgb(dark), np.clip(tone, 0, 1))
        return Coat(colour, height=-0.05 * ring * (late + 0.5 * fibre), smoothness=smoothness)

    return paint


def woven(warp: str, weft: str, *, thread: float, relief: float, seed: int) -> Paint:
    """Plain weave of two yarns, ``thread`` metres from yarn to yarn, uneven as linen is."""

    def paint(texels: Texels) -> Coat:
        x, y = texels.s / thread, texels.t / thread
        flat = np.zeros_like(x)
        over = (np.floor(x) + np.floor(y)) % 2
        across, along = np.sin(np.pi * (x % 1)), np.sin(np.pi * (y % 1))
        lift = np.where(over == 1, across * (0.6 + 0.4 * along), along * (0.6 + 0.4 * across))
        slub = noise(
            np.stack([np.where(over == 1, np.floor(x), x / 9), np.where(over == 1, y / 9, np.floor(y)), flat], -1), seed
        )
        colour = np.where((over == 1)[..., None], rgb(warp), rgb(weft)) * (0.72 + 0.2 * lift + 0.16 * slub)[..., None]
        return Coat(np.clip(colour, 0, 1), height=relief * lift, smoothness=0.1)

    return paint


def segments_distance(x: Array, y: Array, segments: Array) -> Array:
    """Distance of points (...) to the nearest of segments (N, 2, 2)."""
    nearest = np.full(x.shape, np.inf)
    for (ax, ay), (bx, by) in segments:
        dx, dy = bx - ax, by - ay
        along = np.clip(((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1e-18), 0, 1)
        nearest = np.minimum(nearest, np.hypot(x - ax - along * dx, y - ay - along * dy))
    return nearest


def star(x: Array, y: Array, *, points: int, inner: float) -> Array:
    """Signed distance, roughly, to a star of radius 1 around the origin; ``inner`` is the radius of its notches."""
    sector = np.pi / points
    angle = np.abs((np.arctan2(x, y) + sector) % (2 * sector) - sector)
    radius = np.hypot(x, y)
    px, py = radius * np.cos(angle), radius * np.sin(angle)
    edge = np.array([inner * np.cos(sector) - 1.0, inner * np.sin(sector)])
    edge /= np.linalg.norm(edge)
    return np.asarray(py * -edge[0] + (px - 1.0) * edge[1])


_ARC = [(np.sin(a), np.cos(a)) for a in np.linspace(0, np.pi, 9)]
_ROUND = [(0.3 + 0.3 * np.sin(a), 0.5 + 0.5 * np.cos(a)) for a in np.linspace(0, 2 * np.pi, 17)]


def _bowl(y0: float, y1: float, width: float) -> list[tuple[float, float]]:
    """A bow to the right of a stem at x = 0, from height y1 down to y0."""
    middle, half, straight = (y0 + y1) / 2, (y1 - y0) / 2, width - (y1 - y0) / 2 * 0.9
    return [(0.0, y1), *((straight + half * 0.9 * x, middle + half * y) for x, y in _ARC), (0.0, y0)]


_GLYPHS: Final[dict[str, list[list[tuple[float, float]]]]] = {
    "A": [[(0, 0), (0.32, 1), (0.64, 0)], [(0.12, 0.36), (0.52, 0.36)]],
    "C": [_ROUND[2:0:-1] + _ROUND[16:5:-1]],
    "D": [[(0, 0), (0, 1)], _bowl(0, 1, 0.6)],
    "E": [[(0.5, 1), (0, 1), (0, 0), (0.5, 0)], [(0, 0.52), (0.42, 0.52)]],
    "F": [[(0.5, 1), (0, 1), (0, 0)], [(0, 0.52), (0.42, 0.52)]],
    "G": [[*_ROUND[2:0:-1], *_ROUND[16:4:-1], (0.6, 0.45), (0.34, 0.45)]],
    "I": [[(0, 0), (0, 1)]],
    "L": [[(0, 1), (0, 0), (0.48, 0)]],
    "M": [[(0, 0), (0.06, 1), (0.38, 0.3), (0.7, 1), (0.76, 0)]],
    "N": [[(0, 0), (0, 1), (0.56, 0), (0.56, 1)]],
    "O": [_ROUND],
    "P": [[(0, 0), (0, 1)], _bowl(0.45, 1, 0.52)],
    "R": [[(0, 0), (0, 1)], _bowl(0.48, 1, 0.52), [(0.22, 0.48), (0.56, 0)]],
    "S": [
        [
            (0.5, 0.86),
            (0.36, 1),
            (0.14, 1),
            (0, 0.86),
            (0, 0.66),
            (0.14, 0.54),
            (0.38, 0.46),
            (0.52, 0.34),
            (0.52, 0.14),
            (0.38, 0),
            (0.14, 0),
            (0, 0.14),
        ]
    ],
    "T": [[(0.28, 0), (0.28, 1)], [(0, 1), (0.56, 1)]],
    "U": [[(0, 1), (0, 0.28), (0.09, 0.08), (0.28, 0), (0.47, 0.08), (0.56, 0.28), (0.56, 1)]],
    "V": [[(0, 1), (0.3, 0), (0.6, 1)]],
    "'": [[(0.06, 1), (0, 0.78)]],
    "1": [[(0, 0.8), (0.22, 1), (0.22, 0)]],
    "9": [[(0.5, 0.5), (0.1, 0.45), (0, 0.72), (0.12, 0.96), (0.38, 0.98), (0.5, 0.76), (0.46, 0.3), (0.24, 0)]],
    "2": [[(0, 0.8), (0.14, 0.98), (0.38, 0.98), (0.5, 0.76), (0.42, 0.52), (0, 0), (0.54, 0)]],
}


def letters(text: str, x: Array, y: Array, *, height: float) -> Array:
    """Distance (...) of points to the strokes of ``text``, centred at the origin; capitals of ``height``, in metres."""
    pen, segments = 0.0, []
    for letter in text:
        strokes = _GLYPHS.get(letter, [])
        for stroke in strokes:
            line = np.asarray(stroke) + np.array([pen, 0.0])
            segments += list(np.stack([line[:-1], line[1:]], axis=1))
        pen += max((px for stroke in strokes for px, _ in stroke), default=0.2) + 0.26
    placed = (np.asarray(segments) - [(pen - 0.26) / 2, 0.5]) * height
    return segments_distance(x, y, placed)
