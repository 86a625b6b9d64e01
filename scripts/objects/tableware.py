"""Mug, bottle and teapot: surfaces of revolution, with handles and a spout."""

import numpy as np

from objects.brushes import clouds, cover, letters, mix, noise, rgb, smooth, star
from objects.mesh import Array, Coat, Materials, Texels, cap, curve, revolve, tube


def _around(texels: Texels) -> Array:
    """Azimuth (H, W) of the texels around the y axis, radians, 0 at the front."""
    return np.arctan2(texels.position[..., 0], texels.position[..., 2])


# --- mug ---


def _stoneware(texels: Texels) -> Coat:
    """Cream glaze with iron speckles."""
    p = texels.position
    tone = clouds(p * 60, seed=11)
    speckle = smooth(0.83, 0.88, noise(p * 520, seed=15)) * smooth(0.4, 0.6, noise(p * 90, seed=17))
    colour = mix(rgb("e9dcbf"), rgb("d8c49d"), smooth(0.35, 0.7, tone))
    return Coat(mix(colour, rgb("7d5a36"), 0.8 * speckle), smoothness=0.72 + 0.08 * tone)


def _clay(texels: Texels) -> Coat:
    tone = clouds(texels.position * 300, seed=21, octaves=2)
    return Coat(mix(rgb("a8734c"), rgb("c28d62"), tone), smoothness=0.15)


def _mug_wall(texels: Texels) -> Coat:
    """Glaze over a bare foot; a cobalt band that bears an eye in front and the name behind."""
    base, y, angle = _stoneware(texels), texels.position[..., 1], _around(texels)
    x = 0.041 * np.mod(angle + np.pi / 2, np.pi) - 0.041 * np.pi / 2
    brush = 0.0006 * (clouds(texels.position * 110, seed=31) - 0.5)
    band = cover(np.abs(y + brush - 0.05) - 0.0225, texels.pitch)
    wash = clouds(texels.position * [45, 140, 45], seed=35)
    cobalt = mix(rgb("1f3f8f"), rgb("3c68bd"), wash)
    colour = mix(base.colour, cobalt, band)
    for height, width in ((0.0775, 0.0011), (0.0808, 0.0006), (0.0225, 0.0011)):
        line = cover(np.abs(y + brush - height) - width, texels.pitch)
        colour = mix(colour, rgb("27479a"), 0.9 * line)
    front = np.abs(angle) < np.pi / 2
    motif = np.where(front, _eye(x, y - 0.05), letters("TROMPE", x, y - 0.05, height=0.015) - 0.0014)
    inlay = cover(motif, texels.pitch)
    colour = mix(colour, rgb("f1e6cb"), inlay)
    iris = front * cover(np.abs(np.hypot(x, y - 0.05) - 0.0052) - 0.0026, texels.pitch)
    colour = mix(colour, mix(rgb("b9622a"), rgb("e09a3e"), noise(texels.position * 700, seed=37)), iris)
    pupil = front * cover(np.hypot(x, y - 0.05) - 0.0028, texels.pitch)
    colour = mix(colour, rgb("16213f"), pupil)
    bare = cover(y + 2 * brush - 0.009, texels.pitch)
    colour = mix(colour, _clay(texels).colour, bare)
    return Coat(colour, height=0.00025 * (1 - bare) + 0.00008 * band, smoothness=base.smoothness * (1 - 0.75 * bare))


def _eye(x: Array, y: Array) -> Array:
    """Signed distance to an almond-shaped eye with lashes above, 4 cm wide, around the origin."""
    lid = 0.0108
    almond = np.maximum(np.hypot(x, y - 0.011), np.hypot(x, y + 0.011)) - (lid + 0.011)
    angle, radius = np.arctan2(x, y + 0.011), np.hypot(x, y + 0.011)
    lash = np.maximum(np.abs((angle + 0.13) % 0.26 - 0.13) * radius - 0.0007, np.abs(radius - 0.0265) - 0.0022)
    return np.minimum(almond, np.maximum(lash, np.abs(angle) - 0.68))


def mug() -> Materials:
    """A stoneware mug, 9.5 cm high, handle to the right."""
    wall = curve([(0.031, 0.0), (0.0375, 0.004), (0.0405, 0.018), (0.0414, 0.05), (0.0405, 0.08), (0.0412, 0.0930)], 16)
    rim = [(0.0412, 0.0930), (0.0409, 0.0944), (0.0400, 0.0950), (0.0390, 0.0944), (0.0386, 0.0930)]
    inside = curve([(0.0386, 0.0930), (0.0378, 0.06), (0.0372, 0.02), (0.032, 0.008)], 9)
    path = np.zeros((17, 3))
    path[:, :2] = curve(
        [
            (0.0386, 0.0770),
            (0.045, 0.0772),
            (0.0665, 0.069),
            (0.0715, 0.050),
            (0.062, 0.0305),
            (0.046, 0.0255),
            (0.0386, 0.0255),
        ],
        17,
    )
    flare = 1 + 0.3 * np.abs(np.linspace(-1, 1, 17))[:, None] ** 4
    return {
        "mug_ceramic": [
            cap([(0, 0.003), (0.024, 0.003)], _clay, density=0.5),
            revolve([(0.024, 0.003), (0.026, 0.0), (0.031, 0.0)], _clay, density=0.5),
            revolve(wall, _mug_wall),
            revolve(rim, _stoneware),
            revolve(inside, _stoneware, density=0.55),
            cap([(0.032, 0.008), (0.022, 0.0055), (0, 0.005)], _stoneware, density=0.6),
            tube(path, flare * [0.0042, 0.0068], _stoneware, up=(0, 0, 1), density=0.8),
        ]
    }


# --- bottle ---


def _glass(texels: Texels) -> Coat:
    """Bottle green, lighter where the light gathers low and on the shoulder."""
    y = texels.position[..., 1]
    tone = clouds(texels.position * [14, 40, 14], seed=41)
    glow = np.exp(-(((y - 0.012) / 0.03) ** 2)) + 0.7 * np.exp(-(((y - 0.215) / 0.03) ** 2))
    colour = mix(rgb("16301c"), rgb("3f6b2f"), np.clip(0.55 * glow + 0.35 * tone, 0, 1))
    return Coat(colour, smoothness=0.88)


def _bottle_body(texels: Texels) -> Coat:
    glass, y = _glass(texels), texels.position[..., 1] - 0.098
    x = 0.0375 * _around(texels)
    edge = np.maximum(np.abs(x) - 0.062, np.abs(y) - 0.052)
    paper = cover(edge, texels.pitch)
    ink = _label(x, y, texels)
    colour = mix(glass.colour, ink, paper)
    behind = np.sign(x) * (np.abs(x) - 0.0375 * np.pi)
    slip = cover(np.maximum(np.abs(behind) - 0.024, np.abs(y) - 0.034), texels.pitch)
    colour, paper = mix(colour, _back_label(behind, y, texels), slip), np.maximum(paper, slip)
    return Coat(colour, height=0.0002 * paper, smoothness=0.88 - 0.66 * paper)


def _label(x: Array, y: Array, texels: Texels) -> Array:
    """Cream paper: a sun over terraced hills, the name, a red foot with the year, a gold frame."""
    pitch = texels.pitch
    colour = mix(rgb("f0e4c8"), rgb("e2d2ab"), clouds(texels.position * 180, seed=51, octaves=3))
    sky = cover(np.maximum(np.abs(x) - 0.046, np.abs(y - 0.024) - 0.019), pitch)
    colour = mix(colour, mix(rgb("f6c667"), rgb("d9793d"), smooth(0.043, 0.008, y)), sky)
    rays = star(x / 0.0135, (y - 0.019) / 0.0135, points=16, inner=0.72) * 0.0135
    colour = mix(colour, rgb("fff0b8"), sky * cover(np.minimum(rays, np.hypot(x, y - 0.019) - 0.0095), pitch))
    for k, tint in enumerate(("8a9a4b", "5f7d3a", "3c5a2c")):
        crest = 0.019 - 0.006 * k + 0.005 * np.sin(x * (90 + 35 * k) + 2.1 * k)
        colour = mix(colour, rgb(tint), sky * cover(y - crest, pitch))
        rows = cover(np.abs((y - crest) % 0.0026 - 0.0013) - 0.0003, pitch) * (y < crest)
        colour = mix(colour, rgb("263d1f"), 0.5 * sky * rows)
    colour = mix(colour, rgb("3a2318"), cover(letters("VERDE", x, y + 0.0095, height=0.0135) - 0.0013, pitch))
    colour = mix(colour, rgb("3a2318"), cover(letters("OLIO DI LUCE", x, y + 0.0255, height=0.0062) - 0.0006, pitch))
    foot = cover(np.maximum(np.abs(x) - 0.062, y + 0.034), pitch)
    colour = mix(colour, rgb("a3262a"), foot)
    colour = mix(colour, rgb("f0e4c8"), cover(letters("1992", x, y + 0.0425, height=0.0085) - 0.0008, pitch))
    frame = np.abs(np.maximum(np.abs(x) - 0.0585, np.abs(y) - 0.0485)) - 0.0009
    return mix(colour, rgb("c79a3b"), cover(frame, pitch))


def _back_label(x: Array, y: Array, texels: Texels) -> Array:
    """A cream slip: a green star, lines of small print, a bar code."""
    pitch = texels.pitch
    colour = mix(rgb("f0e4c8"), rgb("e2d2ab"), clouds(texels.position * 180, seed=53, octaves=3))
    colour = mix(
        colour, rgb("5f7d3a"), cover(star(x / 0.008, (y - 0.022) / 0.008, points=8, inner=0.55) * 0.008, pitch)
    )
    words = noise(np.stack([x * 420, np.floor(y / 0.0034) * 7.0, np.zeros_like(x)], axis=-1), seed=57) - 0.68
    print_ = np.maximum(
        np.abs((y + 0.0017) % 0.0034 - 0.0017) - 0.0007, np.maximum(np.abs(x) - 0.019, np.abs(y) - 0.0105)
    )
    colour = mix(colour, rgb("3a2318"), 0.8 * cover(np.maximum(print_, 0.004 * words), pitch))
    bars = noise(np.stack([x * 900, np.zeros_like(x), np.zeros_like(x)], axis=-1), seed=59) < 0.5
    return mix(colour, rgb("20160f"), cover(np.maximum(np.abs(x) - 0.013, np.abs(y + 0.0225) - 0.0065), pitch) * bars)


def _foil(texels: Texels) -> Coat:
    """Wine-red capsule with gold rings and a pressed pattern."""
    y = texels.position[..., 1]
    creases = noise(texels.position * [420, 60, 420], seed=61)
    colour = mix(rgb("7e1620"), rgb("a5252f"), creases)
    rings = np.minimum(np.abs(y - 0.2545), np.abs(y - 0.2875)) - 0.0016
    gold = cover(rings, texels.pitch)
    dots = np.hypot((0.0145 * _around(texels)) % 0.0076 - 0.0038, y - 0.271) - 0.0021
    gold = np.maximum(gold, cover(dots, texels.pitch))
    return Coat(
        mix(colour, rgb("d8ab4e"), gold), height=0.00012 * creases + 0.0002 * gold, metallic=0.5 * gold, smoothness=0.6
    )


def bottle() -> Materials:
    """A wine-shaped bottle of olive oil, 30 cm high, labelled in front."""
    foot = curve([(0.030, 0.0), (0.0355, 0.003), (0.0375, 0.012)], 5)
    shoulder = curve([(0.0375, 0.175), (0.0368, 0.192), (0.030, 0.214), (0.019, 0.232), (0.0150, 0.25)], 11)
    neck = [(0.0150, 0.25), (0.0146, 0.262), (0.0143, 0.285)]
    lip = [(0.0143, 0.285), (0.0158, 0.2865), (0.0158, 0.2955), (0.0150, 0.298)]
    return {
        "bottle_glass": [
            cap([(0, 0.010), (0.014, 0.008), (0.026, 0.001), (0.030, 0.0)], _glass, density=0.45),
            revolve(foot, _glass, density=0.6),
            revolve([(0.0375, 0.012), (0.0375, 0.09), (0.0375, 0.175)], _bottle_body),
            revolve(shoulder, _glass, density=0.7),
            revolve(neck, _foil),
            revolve(lip, _foil),
            cap([(0.0150, 0.298), (0.010, 0.2985), (0, 0.2985)], _foil),
        ]
    }


# --- teapot ---


def _celadon(texels: Texels) -> Coat:
    """Pale jade glaze that pools darker in the hollows."""
    tone = clouds(texels.position * 32, seed=71)
    colour = mix(rgb("9fcdb4"), rgb("6fae97"), smooth(0.3, 0.75, tone))
    return Coat(colour, smoothness=0.8)


def _teapot_wall(texels: Texels) -> Coat:
    """Celadon with a branch of plum blossom on each side and gold lines above and below."""
    glaze, y, angle = _celadon(texels), texels.position[..., 1], _around(texels)
    x = 0.075 * (np.mod(angle + np.pi / 2, np.pi) - np.pi / 2)
    colour = glaze.colour
    twig = np.abs(y - 0.047 - 0.30 * x - 0.008 * np.sin(x * 75)) - 0.0019 * (1.2 - x / 0.06)
    side = np.abs(y - 0.060 + 0.8 * (x - 0.006) - 0.004 * np.sin(x * 120)) - 0.0012
    branch = np.minimum(np.maximum(twig, np.abs(x) - 0.062), np.maximum(side, np.abs(x + 0.012) - 0.020))
    colour = mix(colour, rgb("4a3128"), cover(branch, texels.pitch))
    for cx, cy, size in _BLOSSOMS:
        colour = _blossom(colour, (x - cx) / size, (y - cy) / size, texels.pitch / size)
    gold = np.minimum(np.abs(y - 0.0075), np.abs(y - 0.0965)) - 0.0016
    ring = cover(gold, texels.pitch)
    return Coat(
        mix(colour, rgb("c9973f"), ring), height=0.00015 * ring, metallic=0.6 * ring, smoothness=0.8 - 0.15 * ring
    )


_BLOSSOMS = (
    (-0.046, 0.036, 0.0115),
    (-0.018, 0.047, 0.0135),
    (0.013, 0.045, 0.0105),
    (0.036, 0.062, 0.0125),
    (0.057, 0.060, 0.0085),
    (-0.030, 0.083, 0.0105),
    (-0.008, 0.069, 0.0085),
    (0.027, 0.033, 0.0070),
    (-0.060, 0.052, 0.0075),
    (0.012, 0.079, 0.0065),
)
"""Centre and radius of each blossom, metres."""


def _blossom(colour: Array, x: Array, y: Array, pitch: float) -> Array:
    """A flower of radius 1 at the origin, five petals and a yellow heart, over ``colour``."""
    angle, radius = np.arctan2(x, y), np.hypot(x, y)
    reach = 0.66 + 0.34 * np.abs(np.cos(2.5 * angle)) ** 0.6
    petals = cover(radius - reach, pitch)
    tint = mix(rgb("e2577c"), rgb("fbe3e6"), smooth(0.15, 0.95, radius / reach))
    colour = mix(colour, tint, petals)
    stamens = np.maximum(np.abs((angle + 0.314) % 0.628 - 0.314) * radius - 0.035, radius - 0.48)
    colour = mix(colour, rgb("8c1f3f"), cover(stamens, pitch))
    return mix(colour, rgb("f2c043"), cover(radius - 0.17, pitch))


def _lid(texels: Texels) -> Coat:
    glaze, (x, z) = _celadon(texels), (texels.position[..., 0], texels.position[..., 2])
    radius, angle = np.hypot(x, z), np.arctan2(x, z)
    ring = cover(np.abs(radius - 0.0395) - 0.0014, texels.pitch)
    colour = mix(glaze.colour, rgb("c9973f"), ring)
    turn = (angle + np.pi / 6) % (np.pi / 3) - np.pi / 6
    colour = _blossom(
        colour, radius * np.sin(turn) / 0.008, (radius * np.cos(turn) - 0.027) / 0.008, texels.pitch / 0.008
    )
    return Coat(colour, metallic=0.6 * ring, smoothness=0.8)


def _knob(texels: Texels) -> Coat:
    tone = clouds(texels.position * 200, seed=81, octaves=2)
    return Coat(mix(rgb("b98a35"), rgb("d8ae5a"), tone), metallic=0.6, smoothness=0.62)


def _tip(texels: Texels) -> Coat:
    """Celadon with gold at both ends."""
    glaze = _celadon(texels)
    end = np.minimum(texels.t, texels.size[1] - texels.t)
    gold = cover(end - 0.006, texels.pitch)
    return Coat(mix(glaze.colour, rgb("c9973f"), gold), metallic=0.6 * gold, smoothness=0.8 - 0.15 * gold)


def _mouth(texels: Texels) -> Coat:
    """The end of the spout: a porcelain rim around a dark opening."""
    hole = cover(0.003 - texels.t, texels.pitch)
    return Coat(mix(_celadon(texels).colour, rgb("1e2a25"), hole), smoothness=0.8 - 0.7 * hole)


def teapot() -> Materials:
    """A round teapot, 14 cm high, spout to the right."""
    body = curve(
        [(0.040, 0.0), (0.0435, 0.003), (0.066, 0.022), (0.0755, 0.048), (0.070, 0.075), (0.053, 0.095), (0.0445, 0.1)],
        17,
    )
    lid = curve([(0.0445, 0.100), (0.046, 0.103), (0.040, 0.108), (0.024, 0.1165), (0.010, 0.120)], 9)
    knob = curve([(0.0065, 0.119), (0.0055, 0.123), (0.011, 0.129), (0.0115, 0.135), (0.0065, 0.1405)], 9)
    spout, handle = np.zeros((14, 3)), np.zeros((18, 3))
    spout[:, :2] = curve([(0.062, 0.036), (0.086, 0.042), (0.101, 0.064), (0.112, 0.089), (0.127, 0.102)], 14)
    handle[:, :2] = curve(
        [(-0.058, 0.084), (-0.079, 0.099), (-0.106, 0.096), (-0.114, 0.071), (-0.099, 0.046), (-0.062, 0.033)], 18
    )
    width = np.interp(np.linspace(0, 1, 14), [0, 0.35, 1], [0.0235, 0.0150, 0.0098])[:, None]
    mouth = spout[-1] + np.array([[0.0], [0.0003], [0.0006]]) * (spout[-1] - spout[-2]) / np.linalg.norm(
        spout[-1] - spout[-2]
    )
    return {
        "teapot_porcelain": [
            cap([(0, 0.004), (0.036, 0.004), (0.040, 0.0)], _celadon, density=0.4),
            revolve(body, _teapot_wall, segments=36),
            revolve(lid, _lid, segments=36, density=0.8),
            cap([(0.010, 0.120), (0.0065, 0.119), (0, 0.119)], _celadon, segments=36),
            revolve(knob, _knob, segments=16),
            cap([(0.0065, 0.1405), (0.004, 0.1418), (0, 0.1422)], _knob, segments=16),
            tube(spout, width * [1.0, 1.0], _tip, up=(0, 0, 1), sides=14, density=0.8),
            tube(mouth, [[0.0098, 0.0098], [0.0072, 0.0072], [0.0, 0.0]], _mouth, up=(0, 0, 1), sides=14),
            tube(handle, [[0.0058, 0.0078]], _tip, up=(0, 0, 1), sides=10, density=0.8),
        ]
    }
