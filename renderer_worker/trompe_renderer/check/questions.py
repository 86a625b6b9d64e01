"""The questions of a check, in order: each takes a few small pictures; later ones use the answers of earlier ones."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from trompe_renderer.check.findings import FINAL, Finding, fault, ok, warning
from trompe_renderer.check.measures import FAINT, Blob, Picture, blob, border, level, median, patterns, positions
from trompe_renderer.check.probes import FACES, RINGS, TEXTURE, ball, chart, cube, disc, layers, plain, plate
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View, spherical
from trompe_shared.object3d import Object3D
from trompe_shared.sailenv_client import SAILENV

SQUARE: Final = (96, 96)
LENS: Final = {"square": (160, 160), "wide": (161, 215), "tall": (213, 160)}
"""Pictures by which the lens is measured; some sides are odd."""
LIGHT: Final = Light(azimuth=30, elevation=50, intensity=0.6, ambient=0.5)
"""Shows every side of a white object, and none of them white."""
FRONT: Final = View(Camera(1.0, 0, 0), LIGHT, (0, 0, 0))
SLOW: Final = 5.0
"""Seconds a picture that are worth a warning."""
ANGLE: Final = 0.5
"""Degrees by which the field of view may be wrong."""
RATIO: Final = 0.02
"""Share by which a pixel may be wider than high."""
SHIFT: Final = 0.25
"""Pixels by which the picture may be off its middle."""
EXPONENTS: Final = (0.62, 1.8)
"""Slopes of encoded brightness over encoded albedo, both logarithmic, that pass as a tone curve. Encoding twice gives
0.45, not encoding 2.2; the curves of ACES, AgX, Khronos and Reinhard lie between 0.7 and 1.35, Filament's film in dim
light at 1.54."""
DIMMED: Final = 0.6
"""sRGB level of the texture that looks in the first light of the question of gamma as white does in the second,
whatever the tone curve. Without decoding it is 0.32, with two decodings 0.80."""
TWICE: Final = 0.7
"""Level above which textures are decoded twice."""

Size = tuple[int, int]
Findings = Iterator[Finding]


class Render(Protocol):
    """Images of an object, (views, H, W, 3) uint8, sRGB, row 0 on top, not mirrored; ``size`` is (H, W)."""

    def __call__(self, obj: Object3D, views: Sequence[View], /, *, size: Size) -> Picture: ...


def check(render: Render, info: EngineInfo) -> Findings:
    """Ask a renderer for about 40 pictures and say, question by question, whether it keeps Trompe's conventions.

    ``info``: what it says of itself. After a fault that leaves other questions without an answer, these are not asked.
    """
    look = _Look(render)
    for question in QUESTIONS:
        for finding in question(look, info):
            yield finding
            if finding.name in FINAL:
                yield warning("stopped", "Other questions need this one answered; check again afterwards.")
                return


class _Look:
    """Takes pictures, and undoes the faults found so far, so that each question sees its own fault alone."""

    def __init__(self, render: Render) -> None:
        self._render = render
        self.seconds: list[float] = []
        self.first = np.zeros((0, 0, 3), np.uint8)
        self.repeats = True
        """Whether the ``first`` picture is promised to come again, and did so far."""
        self.channels: list[int] = [0, 1, 2]
        self.flips: tuple[int, int] = FLIPS[0]
        self.dims = True
        """Whether the light's intensity has an effect."""
        self.scale = (1.0, 1.0)
        """Measured size of the disc over the expected one, across and down, in a square picture."""

    def raw(self, obj: Object3D, view: View, *, size: Size = SQUARE) -> Picture:
        """The picture as it comes."""
        begun = time.perf_counter()
        (picture,) = self._render(obj, [view], size=size)
        self.seconds.append(time.perf_counter() - begun)
        return np.asarray(picture)

    def at(self, obj: Object3D, view: View = FRONT, *, size: Size = SQUARE) -> Picture:
        """The picture with its channels in order, upright and not mirrored."""
        return self.raw(obj, view, size=size)[:: self.flips[0], :: self.flips[1], self.channels]


def _lit(light: Light, camera: Camera = FRONT.camera) -> View:
    return View(camera, light, (0, 0, 0))


def _pixels(metres: float, size: Size, distance: float = 1.0) -> float:
    """Length on the picture, in pixels, of a length across the camera's axis."""
    return metres / distance * size[0] / 2 / float(np.tan(np.radians(FIELD_OF_VIEW / 2)))


ORANGE: Final = ball(0.15, plain(230, 130, 40), middle=-0.3)
BESIDE: Final = ball(0.15, plain(240, 240, 240), middle=0.32)


def repeats(look: _Look, info: EngineInfo) -> Findings:
    """The same request twice, after another one. Later, with other pictures between, once more."""
    before = look.raw(ORANGE, replace(FRONT, background=(255, 255, 255)))
    look.first, again = look.raw(ORANGE, FRONT), look.raw(ORANGE, FRONT)
    if np.array_equal(before, look.first) and not np.array_equal(look.first, again):
        yield fault("late picture", "A request gives the picture of the one before it.")
        return
    look.repeats = info != SAILENV and np.array_equal(look.first, again)
    if info.deterministic:
        yield from _difference("not repeatable", look.first, again, "equal requests give equal bytes")
        return
    if info == SAILENV:
        yield ok("repeats", f"equal requests differ by {_noise(look.first, again)}; no promise was made.")
        return
    yield from _difference("noise not numbered", look.first, again, "equal noise numbers give equal bytes")
    other = look.raw(ORANGE, replace(FRONT, noise=1))
    if np.array_equal(look.first, other):
        yield fault("noise number ignored", "Noise numbers 0 and 1 give equal pictures.")
    else:
        yield ok("noise", f"{_noise(look.first, other)} on the object.")


def _difference(name: str, one: Picture, other: Picture, well: str) -> Findings:
    changed = int((one != other).any(axis=-1).sum())
    if changed:
        most = int(np.abs(one.astype(int) - other).max())
        yield fault(name, f"Two equal requests differ in {changed} pixel{'s' * (changed > 1)}, by up to {most} levels.")
    else:
        yield ok("repeats", f"{well}.")


def _noise(one: Picture, other: Picture) -> str:
    there = blob(one)
    mask = np.ones(one.shape[:2], bool) if there is None else there.mask
    return f"a noise of {np.std((one.astype(float) - other)[mask]) / np.sqrt(2):.1f} levels of 255"


def channels(look: _Look, _: EngineInfo) -> Findings:
    """An orange ball beside the middle."""
    picture = look.raw(ORANGE, FRONT)
    there = blob(picture)
    if there is None:
        yield fault("invisible", "The picture of a ball near the origin shows nothing.")
        return
    colour = median(picture, there.mask)
    if colour.min() > 250:
        yield fault("overexposed", "An orange ball in moderate light is white.")
        return
    if not _colourful(colour):
        yield fault("untextured", f"An orange ball appears grey: {colour.round()}.")
        return
    look.channels = [int(k) for k in np.argsort(-colour, kind="stable")]
    order = "".join("RGB"[look.channels.index(k)] for k in range(3))
    if order == "RGB":
        yield ok("channels", "red, green, blue.")
    else:
        yield fault("channel order", f"The channels come as {order}.")


def _colourful(colour: NDArray[np.float64]) -> bool:
    return bool(np.ptp(colour) >= 0.15 * colour.max())


def background(look: _Look, _: EngineInfo) -> Findings:
    """Three colours around the ball, and nothing else."""
    worst, told, alone = 0.0, "every level as asked", True
    for asked in ((0, 0, 0), (255, 255, 255), (200, 130, 50)):
        picture = look.at(ORANGE, replace(FRONT, background=asked))
        got = border(picture)
        alone = alone and _alone(np.abs(ndimage.uniform_filter(picture - got, (5, 5, 0))).max(axis=-1) > FAINT)
        if (off := float(np.abs(got - asked).max())) > worst:
            worst, told = off, f"{asked} comes as {tuple(got.round().astype(int).tolist())}"
    yield fault("background", f"A background of {told}.") if worst > 1 else ok("background", f"{told}.")
    if not alone:
        yield fault("extra object", "Around a ball there is something else than a plain background.")


def _alone(differs: NDArray[np.bool_]) -> bool:
    """Whether a picture of the ball ``differs`` from its background near the middle row or column alone."""
    near = np.abs(np.arange(SQUARE[0]) + 0.5 - SQUARE[0] / 2) < 2 * _pixels(0.15, SQUARE)
    return not differs[~near].any() or not differs[:, ~near].any()


def objects(look: _Look, _: EngineInfo) -> Findings:
    """The orange ball, and a white one somewhere else."""
    pictures = [look.raw(obj, FRONT) for obj in (ORANGE, BESIDE)]
    blobs = map(blob, pictures)
    before, now = (np.zeros(SQUARE, bool) if there is None else there.mask for there in blobs)
    kept = (before & now).sum() / max(int(before.sum()), 1)
    orange = now.any() and _alike(median(pictures[1], now), median(pictures[0], before))
    if kept >= 0.5 and (now & ~before).sum() >= 0.5 * before.sum():
        yield fault("stale scene", "The object of an earlier request is still in the picture.")
    elif kept >= 0.5 and orange:
        yield fault("stale object", "A new object of the same name looks like the one before it.")
    elif kept >= 0.5:
        yield fault("moved object", "A ball at x = 0.32 m appears where one at x = -0.3 m did.")
    elif orange:
        yield fault("stale texture", "A white object has the orange texture of the one before it.")
    else:
        yield ok("objects", "nothing is left of an earlier request.")


def _alike(colour: NDArray[np.float64], orange: NDArray[np.float64]) -> bool:
    """Whether a colour is rather ``orange`` than white, at any brightness."""
    own, other = (each / max(each.max(), 1.0) for each in (colour, orange))
    return bool(np.linalg.norm(own - other) < np.linalg.norm(own - 1))


HALF: Final = 0.25
CUBE: Final = cube(HALF)
CUBE_VIEWS: Final = (
    _lit(replace(LIGHT, azimuth=35, elevation=25), Camera(1.1, 35, 25)),
    _lit(replace(LIGHT, azimuth=210, elevation=-35), Camera(1.2, 210, -35, roll=25.0, centre=(0.08, 0.1, 0.05))),
)
"""Each lit from the camera, so that no face needs ambient light."""
FLIPS: Final = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""Steps along rows and columns; the first is right."""
Seen = Mapping[int, tuple[float, float]]


def orientation(look: _Look, _: EngineInfo) -> Findings:
    """A cube of six colours from two sides: which faces are where?"""
    first, second = CUBE_VIEWS
    seen = _faces(look, first)
    found = next((flips for flips in FLIPS if _distance(seen, _expected(first, flips)) < 6), None)
    if found is None:
        there = _expected(first)
        opposite = {7 - kind for kind in there}
        name = "inside out" if seen.keys() == opposite else "parts" if len(seen) == 1 else "axes"
        yield fault(name, f"From azimuth 35, elevation 25 one sees {_named(seen)}, not {_named(there)}.")
        return
    look.flips = found
    if found[0] < 0:
        yield fault("upside down", "Top and bottom are exchanged.")
    if found[1] < 0:
        yield fault("mirrored", "Left and right are exchanged.")
    if _distance(_faces(look, second), _expected(second)) > 8:
        yield fault("camera", "A rolled camera that looks past the origin sees the object elsewhere.")
    elif look.flips == (1, 1):
        yield ok("orientation", "upright, not mirrored, from where the camera is.")


def _faces(look: _Look, view: View) -> Seen:
    picture = look.at(CUBE, view)
    there = blob(picture)
    return {} if there is None else positions(picture, there.mask)


def _expected(view: View, flips: tuple[int, int] = FLIPS[0]) -> Seen:
    """Middle, in pixels from the picture's, of each visible face of the cube, by its colour's pattern."""
    matrix, grid = view.camera.world_to_camera(), np.linspace(-0.9, 0.9, 7)
    a, b = (each.reshape(-1, 1) for each in np.meshgrid(grid, grid))
    found = {}
    for normal, up, colour in FACES.values():
        n, v = np.array(normal), np.array(up)
        if n @ (view.camera.position() - HALF * n) <= 0:
            continue
        x, y, z = matrix[:3, :3] @ (HALF * (n + a * np.cross(v, n) + b * v)).T + matrix[:3, 3:]
        right, down = _pixels(1.0, SQUARE) * np.array([(x / -z).mean(), (y / z).mean()])
        found[int(patterns(np.array(colour)))] = (flips[1] * float(right), flips[0] * float(down))
    return found


def _distance(seen: Seen, expected: Seen) -> float:
    """Pixels between what is seen and what is expected at any scale; infinite if these are not the same colours."""
    if seen.keys() != expected.keys():
        return np.inf
    here, there = (np.array([spots[kind] for kind in sorted(expected)]) for spots in (seen, expected))
    scale = np.clip((here * there).sum() / (there * there).sum(), 0.4, 2.5)
    return float(np.linalg.norm(here / scale - there, axis=1).max())


def _named(seen: Seen) -> str:
    names = {int(patterns(np.array(colour))): name for name, (_, _, colour) in FACES.items()}
    from_left = sorted(seen, key=lambda kind: seen[kind])
    return ", ".join(names[kind] for kind in from_left) or "no face"


QUARTERS: Final = np.array([[(230, 25, 25), (25, 230, 25)], [(25, 25, 230), (230, 230, 25)]], np.uint8)
"""Colours of the texture's quarters, top row first."""
QUARTERED, REPEATED = (
    plate(0.3, QUARTERS.repeat(16, axis=0).repeat(16, axis=1), corner=corner) for corner in ((0, 0), (1, -1))
)


def texture(look: _Look, _: EngineInfo) -> Findings:
    """A square with four colours, and one with the same ones by coordinates beyond the texture."""
    seen = _quarters(look, QUARTERED)
    if seen is None:
        yield fault("invisible", "A square at the origin, seen from the front, is missing.")
        return
    right = patterns(QUARTERS)
    rows, columns = next((flips for flips in FLIPS if (seen == right[:: flips[0], :: flips[1]]).all()), (0, 0))
    if rows == 0:
        yield fault("texture turned", "The quarters of the texture are not where they belong.")
    if rows < 0:
        yield fault("v flipped", "The texture's top row appears at the bottom.")
    if columns < 0:
        yield fault("u flipped", "The texture's left column appears at the right.")
    again = _quarters(look, REPEATED)
    if again is None or (again != seen).any():
        yield fault("texture not repeated", "Coordinates from 1 to 2 and -1 to 0 show another part of the texture.")
    elif (rows, columns) == FLIPS[0]:
        yield ok("texture", "its lower left corner is u = 0, v = 0; it repeats.")


def _quarters(look: _Look, obj: Object3D) -> NDArray[np.int64] | None:
    """Patterns of the colours of a square's quarters, top row first; ``None`` if it is missing."""
    picture = look.at(obj)
    if blob(picture) is None:
        return None
    middle, off = SQUARE[0] // 2, round(_pixels(0.15, SQUARE))
    spots = [
        [picture[middle + y - 3 : middle + y + 4, middle + x - 3 : middle + x + 4] for x in (-off, off)]
        for y in (-off, off)
    ]
    return patterns(np.array([[np.median(spot, axis=(0, 1)) for spot in row] for row in spots]))


RADIUS: Final = 0.28
"""Of the disc by which the lens is measured, and of the chart, metres."""
DISC: Final = disc(RADIUS, plain(190, 190, 190))
CLOSER: Final = 0.3
CLOSER_DISC: Final = disc(RADIUS * (1 - CLOSER), plain(190, 190, 190), corners=70, z=CLOSER)
"""Looks as large as the other one, if what is nearer looks larger."""
CHART: Final = chart(RADIUS)


def lens(look: _Look, _: EngineInfo) -> Findings:
    """A disc in pictures of three shapes; in the square one before black and white, whose edges bias oppositely."""
    shots = {name: shot for name, size in LENS.items() if (shot := _ellipse(look, FRONT, size))}
    white = _ellipse(look, replace(FRONT, background=(255, 255, 255)), LENS["square"])
    if shots.keys() != LENS.keys():
        yield fault("invisible", "A disc at the origin is missing in some of the pictures.")
        return
    if white is None:
        yield fault("overexposed", "A light grey disc in moderate light is white.")
        return
    square = shots["square"]
    look.scale = square.spread
    yield from _field_of_view((square.spread[1] + white.spread[1]) / 2)
    yield from _aspect(shots)
    closer = _ellipse(look, FRONT, LENS["square"], CLOSER_DISC)
    if closer is None or closer.spread[1] < (1 - CLOSER / 2) * square.spread[1]:
        yield fault("orthographic", "A disc that is nearer looks no larger.")
    x, y = np.mean([square.centre, white.centre], axis=0)
    ways = [(x, "right" if x > 0 else "left"), (y, "down" if y > 0 else "up")]
    if off := [f"{abs(pixels):.2f} pixels too far {way}" for pixels, way in ways if abs(pixels) > SHIFT]:
        yield fault("shifted", f"The picture lies {' and '.join(off)}.")
    else:
        yield ok("centre", f"off by {np.hypot(x, y):.2f} pixels.")


def _ellipse(look: _Look, view: View, size: Size, obj: Object3D = DISC) -> Blob | None:
    """The disc, with its spread over the expected one."""
    shape = blob(look.at(obj, view, size=size))
    expected = _pixels(RADIUS, size) / 2
    return shape and replace(shape, spread=(shape.spread[0] / expected, shape.spread[1] / expected))


def _field_of_view(size: float) -> Findings:
    found = 2 * float(np.degrees(np.arctan(np.tan(np.radians(FIELD_OF_VIEW / 2)) / size)))
    if abs(found - FIELD_OF_VIEW) > ANGLE:
        yield fault("field of view", f"The vertical field of view is {found:.1f} degrees, not {FIELD_OF_VIEW:g}.")
    else:
        yield ok("field of view", f"{found:.1f} degrees.")


def _aspect(shots: Mapping[str, Blob]) -> Findings:
    square = shots["square"].spread[1]
    sheared = [name for name, shot in shots.items() if abs(shot.shear) > 0.05]
    if sheared:
        yield fault("sheared", f"The rows of {' and '.join(sheared)} pictures lean.")
    wrong = [
        f"{across / square:.2f} x {down / square:.2f} in a {name} picture"
        for name, (across, down) in ((name, shot.spread) for name, shot in shots.items() if name not in sheared)
        if max(abs(across / down - 1), abs(down / square - 1)) > RATIO
    ]
    if wrong:
        yield fault("aspect", f"A disc is stretched, width x height, {', '.join(wrong)}.")
    elif not sheared:
        yield ok("aspect", "pixels are square in square, wide and tall pictures.")


def gamma(look: _Look, info: EngineInfo) -> Findings:
    """Greys in one light, and in another one that is as much weaker as the texture level ``DIMMED`` is darker."""
    weaker = float(((DIMMED + 0.055) / 1.055) ** 2.4)
    dim = replace(LIGHT, intensity=weaker * LIGHT.intensity, ambient=weaker * LIGHT.ambient)
    bright, dark = (_rings(look, look.at(CHART, _lit(light))) for light in (LIGHT, dim))
    slope = float(np.polyfit(np.log(RINGS[1:]), np.log(bright[1:]), 1)[0])
    same = DIMMED if info == SAILENV or not look.dims else float(np.interp(dark[0], bright[::-1], RINGS[::-1]))
    told = f"A texture's greys come with the exponent {slope:.2f}, expected about 1."
    decoded = 0 if same < (DIMMED + weaker) / 2 else 2 if same > TWICE else 1
    encoding = slope / 2.2 ** (decoded - 1)
    if decoded == 0 and encoding > EXPONENTS[1]:
        yield warning("light on encoded colours", "Light multiplies encoded colours.")
        return
    if decoded != 1:
        yield fault("texture decoded twice" if decoded else "texture not decoded", told)
    if not EXPONENTS[0] <= encoding <= EXPONENTS[1]:
        yield fault("gamma twice" if encoding < 1 else "gamma missing", told)
    elif decoded == 1:
        yield ok("gamma", f"greys keep their order and distance (exponent {slope:.2f}).")


def _rings(look: _Look, picture: Picture) -> list[float]:
    """Brightness of each of the chart's rings."""
    rows, columns = np.indices(picture.shape[:2]) + 0.5
    x, y = (columns - SQUARE[1] / 2) / look.scale[0], (rows - SQUARE[0] / 2) / look.scale[1]
    ring = np.hypot(x, y) / _pixels(RADIUS, SQUARE) * len(RINGS)
    return [max(level(picture, np.abs(ring - k - 0.5) < 0.25), 1.0) for k in range(len(RINGS))]


FRAMED: Final = {
    level: plate(0.29, np.pad(plain(110, 110, 110), ((2, 2), (2, 2), (0, 0)), constant_values=level))
    for level in (5, 190)
}
"""A grey square in a dark and in a bright frame."""
ADAPTED: Final = 8.0
"""Levels by which a bright surrounding may change the grey, as bloom does."""


def exposure(look: _Look, _: EngineInfo) -> Findings:
    """The same grey in a dark picture and in a bright one."""
    middle = np.s_[SQUARE[0] // 2 - 4 : SQUARE[0] // 2 + 4, SQUARE[1] // 2 - 4 : SQUARE[1] // 2 + 4]
    dark, bright = (
        float(np.median(look.at(obj, replace(FRONT, background=(level,) * 3))[middle])) for level, obj in FRAMED.items()
    )
    if abs(bright - dark) > ADAPTED:
        yield fault("exposure", f"A grey comes as {dark:.0f} in a dark picture, as {bright:.0f} in a bright one.")


SUN: Final = Light(azimuth=60, elevation=35, intensity=1.0, ambient=0.0)
SIDES: Final = (Camera(2.0, 0, 0), Camera(2.0, 110, 10))
BEHIND: Final = Camera(2.0, 180, -10)
BALL_RADIUS: Final = 0.38
BALL: Final = ball(BALL_RADIUS, plain(230, 230, 230))
TOLERANCE: Final = 30.0
"""Degrees by which the brightest direction may differ from the light's."""


AMBIENT: Final = 0.6
TINT: Final = (255, 40, 40)
TINTED: Final = 16.0
"""Levels by which a tinted light may differ from a white one that is as strong in a channel, as by a film's curve."""
FAINT_LIGHT: Final = 0.001
"""Intensity of a light that shows nothing, but is there."""


def light(look: _Look, _: EngineInfo) -> Findings:
    """A white ball in ambient light alone, in none from two sides, and in directional light alone from two sides."""
    soft, faint, *unlit = (
        look.at(BALL, _lit(Light(intensity=intensity, ambient=ambient), camera))
        for intensity, ambient, camera in (
            (FAINT_LIGHT, AMBIENT, SIDES[0]),
            (FAINT_LIGHT, 0.0, SIDES[0]),
            (0.0, 0.0, SIDES[0]),
            (0.0, 0.0, BEHIND),
        )
    )
    rows, columns = np.indices(SQUARE) + 0.5 - SQUARE[0] / 2
    x, y = (places / _pixels(BALL_RADIUS, SQUARE, 2.0) for places in (columns, -rows))
    inside = np.hypot(x, y) < 0.95
    normals = np.stack([x, y, np.sqrt(np.clip(1 - x**2 - y**2, 0, None))], axis=-1)[inside]
    if level(soft, inside) < 20:
        yield fault("ambient missing", "A white ball in ambient light alone is dark.")
    if (seen := max(float(np.percentile(picture[inside], 95)) for picture in unlit)) > 20:
        shown = level(unlit[0], inside) > 20
        look.dims = not shown or level(faint, inside) <= 20
        faded = shown and look.dims
        name, also = ("not shaded", ", in faint light hardly any") if faded else ("extra light", "")
        yield fault(name, f"A white ball without light has a brightness of {seen:.0f} of 255{also}.")
    hard = [look.at(BALL, _lit(SUN, side)) for side in SIDES]
    if max(float(np.percentile(picture[inside], 95)) for picture in hard) < 20:
        yield fault("light missing", "A white ball in directional light alone is dark.")
        return
    guesses = [_brightest(normals, picture[inside].mean(axis=1)) for picture in hard]
    yield from _direction(guesses)
    asked = SIDES[0].world_to_camera()[:3, :3] @ spherical(SUN.azimuth, SUN.elevation)
    if not look.dims:
        return
    yield from _colour(look, hard[0], inside)
    if look.dims and _angle(guesses[0], asked) <= TOLERANCE:
        yield from _balance(level(soft, inside), hard[0][inside], normals @ asked)


def _brightest(normals: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction (3,) to the light, in camera coordinates, under which a matt ball looks most like ``seen``."""
    heights = 1 - (2 * np.arange(1500) + 1) / 1500
    turns, widths = np.arange(1500) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - heights**2)
    ways = np.stack([widths * np.cos(turns), heights, widths * np.sin(turns)], axis=1)
    shaded = np.clip(normals @ ways.T, 0, None) ** 0.45
    shaded -= shaded.mean(axis=0)
    likeness = (seen - seen.mean()) @ shaded / (np.linalg.norm(shaded, axis=0) + 1e-3)
    return np.asarray(ways[likeness.argmax()])


def _angle(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def _direction(guesses: Sequence[NDArray[np.float64]]) -> Findings:
    """Judge the directions to the light, in camera coordinates, seen from ``SIDES``."""
    true = spherical(SUN.azimuth, SUN.elevation)
    world = [side.world_to_camera()[:3, :3].T @ guess for side, guess in zip(SIDES, guesses, strict=True)]
    off = max(_angle(each, true) for each in world)
    asked = f"azimuth {SUN.azimuth:g}, elevation {SUN.elevation:g}"
    places = " and ".join(
        f"azimuth {np.degrees(np.arctan2(w[0], w[2])):.0f}, elevation {np.degrees(np.arcsin(w[1])):.0f}" for w in world
    )
    said = f"Light from {asked} seems to come from {places} (cameras at azimuth 0 and 110)."
    if off <= TOLERANCE:
        yield ok("light", f"comes from where it should, to {off:.0f} degrees.")
    elif _angle(*guesses) < TOLERANCE:
        yield fault("light follows camera", said)
    elif max(_angle(each, -true) for each in world) <= TOLERANCE:
        yield fault("light reversed", said)
    else:
        yield fault("light direction", said)


def _colour(look: _Look, white: Picture, inside: NDArray[np.bool_]) -> Findings:
    """A weaker, redder light, and a white one as weak as its green and blue."""
    weak, weaker = (
        look.at(BALL, _lit(replace(SUN, intensity=intensity, colour=colour), SIDES[0]))
        for intensity, colour in ((0.15, TINT), (0.15 * TINT[1] / 255, SUN.colour))
    )
    levels = white.mean(axis=-1)
    bright = inside & (levels > min(np.percentile(levels[inside], 60), levels[inside].max() - 1))  # all may be white
    seen = median(weak, bright)
    if seen[0] > 0.9 * median(white, bright)[0]:
        look.dims = False
        yield fault("light intensity", "0.15 of the light's intensity looks as bright as 1.")
    elif np.abs(seen[1:] - level(weaker, bright)).max() > TINTED:
        yield fault("light colour", f"In light of the colour {TINT} a white ball is {seen.round()}.")


def _balance(soft: float, hard: Picture, facing: NDArray[np.float64]) -> Findings:
    """Ambient light of ``AMBIENT`` looks brighter than light of 1 that grazes, and darker than light that faces."""
    grazed, faced = level(hard, (facing > 0.2) & (facing < 0.3)), level(hard, facing > 0.9)
    if soft >= 20 and not grazed - FAINT < soft < faced + FAINT:
        yield fault(
            "light balance",
            f"A white ball has a brightness of {soft:.0f} in ambient light of {AMBIENT}, of {faced:.0f} where it faces "
            f"directional light of 1, of {grazed:.0f} at 75 degrees to that.",
        )


GREY: Final = plate(0.25, plain(110, 110, 110))


def repaint(look: _Look, _: EngineInfo) -> Findings:
    """A slightly brighter paint on the same object."""
    old = look.at(GREY)
    there = blob(old)
    if there is None:
        yield fault("invisible", "A grey square at the origin is missing.")
        return
    painted = GREY.with_textures({TEXTURE: plain(140, 140, 140)})
    first, second = (level(look.at(painted), there.mask) - level(old, there.mask) for _ in range(2))
    if first > 4:
        yield ok("repaint", f"a texture 30 levels brighter shows, by {first:.0f}.")
    elif second > 4:
        yield fault("late texture", "A new texture shows in the second picture only.")
    else:
        yield fault("frozen texture", "A new texture on the same mesh does not show.")


NEAR_AND_FAR: Final = {0.11: plate(0.03, plain(240, 240, 240)), 9.9: plate(2.7, plain(240, 240, 240))}
"""A square at each distance."""


RED, BLUE = (230, 25, 25), (25, 25, 230)
LAYERS: Final = layers(0.12, np.array([[RED, BLUE, BLUE, RED]], np.uint8).repeat(16, axis=0).repeat(4, axis=1))
"""Red before blue."""


def depths(look: _Look, _: EngineInfo) -> Findings:
    """A near object and a far one, and one part before another."""
    picture, off = look.at(LAYERS), round(_pixels(0.144, SQUARE, 0.95))
    spots = [picture[46:50, 48 + x - 2 : 48 + x + 2].reshape(-1, 3) for x in (-off, off)]
    if (patterns(np.median(spots, axis=1)) != 4).any():
        yield fault("depth", "A square is seen through another one before it.")
    for distance, obj in NEAR_AND_FAR.items():
        if blob(look.at(obj, _lit(LIGHT, Camera(distance, 0, 0)))) is None:
            yield fault("clipped", f"A square {distance} m before the camera is missing.")


def once_more(look: _Look, info: EngineInfo) -> Findings:
    """The first picture again, after all others."""
    if look.repeats and not np.array_equal(look.first, last := look.raw(ORANGE, FRONT)):
        yield from _difference("not repeatable" if info.deterministic else "noise not numbered", look.first, last, "")


def speed(look: _Look, _: EngineInfo) -> Findings:
    """The time of all pictures so far."""
    seconds = float(np.median(look.seconds))
    told = f"{seconds:.2g} s a picture, the median of {len(look.seconds)} small ones."
    yield warning("slow", told) if seconds > SLOW else ok("speed", told)


QUESTIONS: Final[tuple[Callable[[_Look, EngineInfo], Findings], ...]] = (
    repeats,
    channels,
    background,
    objects,
    orientation,
    texture,
    exposure,
    light,
    lens,
    gamma,
    repaint,
    depths,
    once_more,
    speed,
)
