"""Table lamp, chair and table."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from objects.brushes import clouds, cover, mix, noise, rgb, smooth, wood, woven
from objects.mesh import Array, Coat, Materials, Paint, Patch, Texels, Warp, bevelled_box, cap, curve, moved, revolve


def _shift(*offset: float) -> Warp:
    return lambda points: points + np.array(offset)


# --- lamp ---


def _linen(texels: Texels) -> Coat:
    """Woven shade, warm where the bulb is near, with a printed leaf frieze and rolled hems."""
    weave = woven("f0dfb8", "e6cf9f", thread=0.0042, relief=0.0009, seed=101)(texels)
    y = (texels.t / texels.size[1] - 0.5) * 2
    colour = mix(weave.colour, rgb("f7e3ae"), 0.35 * np.exp(-((y / 0.6) ** 2)))
    cell = texels.size[0] / 5
    x, z = (texels.s % cell) - cell / 2, texels.t - texels.size[1] / 2
    for sign in (-1, 1):
        u, v = (x + sign * z) * np.sqrt(0.5), (z - sign * x) * np.sqrt(0.5)
        leaf = np.abs(u) - 0.0165 * (1 - (v / 0.043) ** 2)
        colour = mix(colour, rgb("b5482f") if sign > 0 else rgb("3d6b62"), 0.85 * cover(leaf, texels.pitch))
    colour = mix(colour, rgb("e0a83c"), 0.9 * cover(np.hypot(x, z) - 0.0095, texels.pitch))
    hem = cover(texels.size[1] / 2 - np.abs(z) - 0.0085, texels.pitch)
    stitch = 0.75 + 0.25 * np.sin(texels.s / 0.0012)
    colour = mix(colour, rgb("8c3a28") * stitch[..., None], hem)
    return Coat(colour, height=np.asarray(weave.height) * (1 - hem) + 0.0015 * hem, smoothness=0.08)


def _lining(texels: Texels) -> Coat:
    glow = np.exp(-(((texels.t / texels.size[1] - 0.45) / 0.35) ** 2))
    return Coat(mix(rgb("d9c08a"), rgb("ffedbd"), glow), smoothness=0.1)


def _glazed_base(texels: Texels) -> Coat:
    """Petrol glaze, crackled, running into ochre at the foot."""
    p = texels.position
    run = p[..., 1] + 0.05 * (clouds(p * [60, 12, 60], seed=121) - 0.5)
    colour = mix(rgb("b8893f"), rgb("1d6470"), smooth(0.035, 0.085, run))
    colour = mix(colour, rgb("0f3c4a"), smooth(0.45, 0.75, clouds(p * 28, seed=125)))
    colour = mix(colour, rgb("e8d9ae"), 0.85 * smooth(0.185, 0.2, run + 0.01))
    crackle = np.minimum(np.abs(noise(p * 75, seed=131) - 0.5), np.abs(noise(p * 105, seed=133) - 0.5))
    lines = 1 - smooth(0.006, 0.022, crackle)
    return Coat(mix(colour, rgb("082a33"), 0.45 * lines), height=-0.0002 * lines, smoothness=0.82)


def _brass(texels: Texels) -> Coat:
    tone = clouds(texels.position * [60, 240, 60], seed=141, octaves=3)
    colour = mix(rgb("b08a3e"), rgb("d9b869"), tone)
    return Coat(mix(colour, rgb("6f5424"), smooth(0.62, 0.8, tone)), metallic=0.75, smoothness=0.55 + 0.2 * tone)


def lamp() -> Materials:
    """A table lamp, 46 cm high: glazed gourd, brass stem, linen shade."""
    foot = [(0.068, 0.0), (0.072, 0.004), (0.072, 0.012), (0.066, 0.017), (0.052, 0.020)]
    gourd = curve(
        [
            (0.052, 0.020),
            (0.074, 0.052),
            (0.079, 0.088),
            (0.060, 0.135),
            (0.034, 0.170),
            (0.026, 0.198),
            (0.030, 0.215),
        ],
        20,
    )
    collar = curve([(0.030, 0.215), (0.026, 0.222), (0.014, 0.226), (0.0085, 0.232), (0.0085, 0.262)], 8)
    socket = [(0.0085, 0.262), (0.017, 0.266), (0.017, 0.300), (0.0085, 0.304), (0.005, 0.306), (0.005, 0.438)]
    finial = curve([(0.005, 0.438), (0.012, 0.441), (0.004, 0.446), (0.011, 0.454), (0.006, 0.463)], 9)
    spoke = bevelled_box((0.092, 0.003, 0.004), _brass, bevel=0.0008)
    spokes = [_spoke(angle) for angle in (0.0, 2 * np.pi / 3, 4 * np.pi / 3)]
    return {
        "lamp_base": [
            cap([(0, 0.002), (0.068, 0.0)], _brass, density=0.35),
            revolve(foot, _brass, density=0.8),
            revolve(gourd, _glazed_base),
            revolve(collar, _brass, segments=20),
            revolve(socket, _brass, segments=12, density=0.7),
            revolve(finial, _brass, segments=14),
            cap([(0.006, 0.463), (0, 0.465)], _brass, segments=14),
            *(moved(patch, warp) for warp in spokes for patch in spoke.values()),
        ],
        "lamp_shade": [*_half_shade((-180, 0)), *_half_shade((0, 180))],
    }


def _half_shade(arc: tuple[float, float]) -> list[Patch]:
    """Cloth, lining, and the rims between them; in halves, because all around is too long for a square texture."""
    outside, inside = (
        [(0.142, 0.235), (0.118, 0.340), (0.095, 0.442)],
        [(0.0925, 0.442), (0.1155, 0.340), (0.1395, 0.235)],
    )
    return [
        revolve(outside, _linen, segments=20, arc=arc),
        revolve([outside[-1], inside[0]], _lining, segments=20, arc=arc, density=0.55),
        revolve(inside, _lining, segments=20, arc=arc, density=0.55),
        revolve([inside[-1], outside[0]], _lining, segments=20, arc=arc, density=0.55),
    ]


def _spoke(angle: float) -> Warp:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return lambda points: (points + np.array([0.046, 0.4365, 0.0])) @ turn.T


# --- chair ---


def _beech(*, along: int, seed: int) -> Paint:
    return wood(light="d9a066", dark="8a5228", ring=0.011, along=along, seed=seed)


def _lean(points: Array) -> Array:
    """Let the back of the chair lean: above the seat, further back the higher, and slightly curved."""
    up = np.maximum(points[..., 1] - 0.44, 0)
    bent = points.copy()
    bent[..., 2] -= 0.16 * up + 0.18 * up**2
    return bent


def _bow(points: Array) -> Array:
    """Curve a slat of the back around the sitter, then lean it."""
    bent = points.copy()
    bent[..., 2] -= 0.045 * (1 - (points[..., 0] / 0.2) ** 2)
    return _lean(bent)


def _tapered(foot: Array, head: Array, *, slim: float) -> Warp:
    """Put a unit-height bar (y in 0..1) between two points, ``slim`` times as thick at the foot as at the head."""

    def warp(points: Array) -> Array:
        y = points[..., 1:2]
        thick = slim + (1 - slim) * np.clip(y * 1.6, 0, 1)
        across = points * [1, 0, 1] * thick
        return np.asarray(across + foot * (1 - y) + head * y)

    return warp


def _leg(
    foot: Sequence[float], head: Sequence[float], *, thick: float, seed: int, cuts: int = 1, bend: Warp | None = None
) -> list[Patch]:
    """A tapered bar of square section from foot to head."""
    start, end = np.asarray(foot), np.asarray(head)
    place, length = _tapered(start, end, slim=0.68), float(np.linalg.norm(end - start))
    paint = _beech(along=1, seed=seed)
    bevel = thick * 0.22

    def warp(points: Array) -> Array:
        placed = place(points * [1, 1 / length, 1] + [0, 0.5, 0])
        return placed if bend is None else bend(placed)

    return list(bevelled_box((thick, length, thick), paint, bevel=bevel, cuts=(1, cuts, 1), warp=warp).values())


def _rail(
    size: Sequence[float],
    centre: Sequence[float],
    *,
    along: int,
    seed: int,
    cuts: Sequence[int] = (1, 1, 1),
    warp: Warp | None = None,
) -> list[Patch]:
    paint = _beech(along=along, seed=seed)
    return list(bevelled_box(size, paint, centre=centre, bevel=0.004, cuts=cuts, warp=warp).values())


def _cushion_cloth(texels: Texels) -> Coat:
    """Striped cloth: broad red, narrow cream and teal."""
    weave = woven("f4ead4", "dccfb2", thread=0.0075, relief=0.0014, seed=161)(texels)
    x = texels.position[..., 0]
    stripe = np.abs((x + 0.06) % 0.12 - 0.06)
    colour = weave.colour
    shade = (colour.mean(axis=-1) / 0.85)[..., None]
    colour = mix(colour, rgb("b03a33") * shade, cover(stripe - 0.024, texels.pitch))
    colour = mix(colour, rgb("2e6f73") * shade, cover(np.abs(stripe - 0.041) - 0.006, texels.pitch))
    return Coat(np.clip(colour, 0, 1), height=weave.height, smoothness=0.08)


def _pillow(points: Array) -> Array:
    """Puff up a flat box into a cushion."""
    puffed = points.copy()
    x, z = np.clip(np.abs(points[..., 0]) / 0.195, 0, 1), np.clip(np.abs(points[..., 2] - 0.005) / 0.19, 0, 1)
    dome = (1 - x**4) * (1 - z**4)
    puffed[..., 1] += np.where(points[..., 1] > 0.475, 0.022 * dome, 0.0)
    return puffed


def chair() -> Materials:
    """A ladder-back dining chair, 93 cm high, with a striped cushion."""
    wooden: list[Patch] = []
    for side in (-1.0, 1.0):
        wooden += _leg((side * 0.205, 0.0, 0.205), (side * 0.185, 0.445, 0.185), thick=0.040, seed=201)
        wooden += _leg((side * 0.195, 0.0, -0.225), (side * 0.182, 0.445, -0.185), thick=0.040, seed=203)
        wooden += _leg(
            (side * 0.192, 0.92, -0.185), (side * 0.182, 0.44, -0.185), thick=0.038, seed=205, cuts=4, bend=_lean
        )
        wooden += _rail((0.020, 0.022, 0.36), (side * 0.193, 0.20, -0.005), along=2, seed=207)
        wooden += _rail((0.022, 0.050, 0.34), (side * 0.185, 0.415, 0.0), along=2, seed=209)
    wooden += _rail((0.37, 0.022, 0.020), (0.0, 0.20, -0.02), along=0, seed=211)
    wooden += _rail((0.34, 0.050, 0.022), (0.0, 0.415, 0.187), along=0, seed=213)
    wooden += _rail((0.34, 0.050, 0.022), (0.0, 0.415, -0.187), along=0, seed=215)
    wooden += _rail((0.43, 0.024, 0.42), (0.0, 0.452, 0.005), along=2, seed=217)
    for y, height in ((0.86, 0.085), (0.735, 0.055), (0.625, 0.055)):
        wooden += _rail(
            (0.365, height, 0.018), (0.0, y, -0.178), along=0, seed=int(1000 * y), cuts=(6, 1, 1), warp=_bow
        )
    cushion = bevelled_box(
        (0.39, 0.034, 0.38), _cushion_cloth, centre=(0, 0.482, 0.005), bevel=0.013, cuts=(6, 1, 6), warp=_pillow
    )
    visible = [patch for patch in wooden if patch.points[:, 1].max() > 0.012]
    return {
        "chair_wood": visible,
        "chair_cushion": [
            replace(patch, density=0.25) if name == "bottom" else patch for name, patch in cushion.items()
        ],
    }


# --- table ---


def _marquetry(texels: Texels) -> Coat:
    """The table's top: oak border, dark string inlay, a chequered field of light and dark squares around a star."""
    x, z = texels.position[..., 0], texels.position[..., 2]
    oak = wood(light="c98f52", dark="7a4a22", along=0, ring=0.016, seed=301, smoothness=0.6)(texels)
    maple = wood(light="f0d9ab", dark="cfa96c", along=0, ring=0.012, seed=311)(texels).colour
    walnut = wood(light="6f4526", dark="3a2113", along=2, ring=0.012, seed=321)(texels).colour
    square = 0.1
    dark = (np.floor(x / square) + np.floor(z / square)) % 2 == 1
    field = np.maximum(np.abs(x) - 5 * square, np.abs(z) - 3 * square)
    colour = mix(oak.colour, np.where(dark[..., None], walnut, maple), cover(field, texels.pitch))
    strings = np.minimum(np.abs(field - 0.006) - 0.006, np.abs(field - 0.045) - 0.003)
    colour = mix(colour, rgb("2a170d"), cover(strings, texels.pitch))
    seam = np.minimum(np.abs((x + square / 2) % square - square / 2), np.abs((z + square / 2) % square - square / 2))
    gap = cover(seam - 0.001, texels.pitch) * cover(field, texels.pitch)
    colour = mix(colour, rgb("2a170d"), 0.6 * gap)
    return Coat(colour, height=np.asarray(oak.height) - 0.0006 * gap, smoothness=0.62)


def _drawer(texels: Texels) -> Coat:
    """An apron with a drawer drawn in it: a dark gap and a brass knob."""
    grain = wood(light="c98f52", dark="7a4a22", along=0, ring=0.016, seed=331)(texels)
    x, y = texels.s - texels.size[0] / 2, texels.t - texels.size[1] / 2
    gap = np.abs(np.maximum(np.abs(x) - 0.22, np.abs(y) - 0.036)) - 0.0022
    colour = mix(grain.colour, rgb("1d0f07"), cover(gap, texels.pitch))
    return Coat(colour, height=np.asarray(grain.height) - 0.003 * cover(gap, texels.pitch), smoothness=0.5)


def _knob(texels: Texels) -> Coat:
    tone = clouds(texels.position * 200, seed=351, octaves=2)
    return Coat(mix(rgb("a8823a"), rgb("dbb968"), tone), metallic=0.8, smoothness=0.65)


def table() -> Materials:
    """A dining table, 1.3 m long and 74 cm high: inlaid top, turned legs, a drawer on each long side."""
    oak_x = wood(light="c98f52", dark="7a4a22", along=0, ring=0.016, seed=341)
    oak_y = wood(light="c98f52", dark="7a4a22", along=1, ring=0.016, seed=343)
    oak_z = wood(light="c98f52", dark="7a4a22", along=2, ring=0.016, seed=345)
    top = bevelled_box((1.3, 0.034, 0.82), oak_x, centre=(0, 0.723, 0), bevel=0.008)
    top["top"] = replace(top["top"], paint=_marquetry, density=1.5)
    top["bottom"] = replace(top["bottom"], density=0.4)
    patches = list(top.values())
    for side in (-1, 1):
        apron = bevelled_box((1.0, 0.1, 0.024), oak_x, centre=(0, 0.658, side * 0.31), bevel=0.003)
        apron["front" if side > 0 else "back"] = replace(apron["front" if side > 0 else "back"], paint=_drawer)
        apron["back" if side > 0 else "front"] = replace(apron["back" if side > 0 else "front"], density=0.5)
        patches += [patch for name, patch in apron.items() if name in {"front", "back", "bottom"}]
        end = bevelled_box((0.024, 0.1, 0.55), oak_z, centre=(side * 0.55, 0.658, 0), bevel=0.003)
        patches += [patch for name, patch in end.items() if name in {"left", "right", "bottom"}]
        patches += [moved(patch, _knob_place(side)) for patch in _turned_knob()]
        for depth in (-1, 1):
            patches += [moved(patch, _shift(side * 0.55, 0, depth * 0.31)) for patch in _turned_leg(oak_y)]
    return {"table_oak": patches}


def _turned_leg(paint: Paint) -> list[Patch]:
    """Square where it joins the apron, turned below: bead, vase, bead, foot."""
    block = bevelled_box((0.078, 0.13, 0.078), paint, centre=(0, 0.641, 0), bevel=0.006)
    vase = curve(
        [
            (0.022, 0.0),
            (0.028, 0.02),
            (0.021, 0.05),
            (0.019, 0.075),
            (0.027, 0.16),
            (0.035, 0.34),
            (0.030, 0.46),
            (0.020, 0.52),
        ],
        14,
    )
    beads = curve([(0.020, 0.52), (0.034, 0.535), (0.022, 0.552), (0.036, 0.568), (0.036, 0.58)], 8)
    return [
        *(patch for name, patch in block.items() if name != "top"),
        revolve(vase, paint, segments=12),
        revolve(beads, paint, segments=12),
        cap([(0, 0.0), (0.022, 0.0)], paint, segments=12, density=0.4),
    ]


def _turned_knob() -> list[Patch]:
    stem = curve([(0.010, 0.0), (0.009, 0.008), (0.020, 0.020), (0.018, 0.030)], 6)
    return [
        revolve(stem, _knob, segments=10, density=1.5),
        cap([(0.018, 0.030), (0.010, 0.034), (0, 0.035)], _knob, segments=10, density=1.5),
    ]


def _knob_place(side: int) -> Warp:
    """Turn the knob's axis from y to the outside of the apron on this side (+z or -z)."""
    return lambda points: np.stack(
        [side * points[..., 0], -points[..., 2] + 0.658, side * (points[..., 1] + 0.322)], axis=-1
    )
