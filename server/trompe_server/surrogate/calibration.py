"""Calibration: find the target's texture sampling and the cheapest sufficient colour model from images alone.

The target stays a black box. It renders the object painted in greys and in random noise; the score of a hypothesis is
its prediction of the change that the noise makes in the target's images.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from itertools import product
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.surrogate.fidelity import Fidelity, measure_fidelity
from trompe_server.surrogate.rasterize import Visibility
from trompe_server.surrogate.sampling import SamplingModel
from trompe_server.surrogate.surrogate import (
    NO_BACKDROPS,
    Geometry,
    Image8,
    Painted,
    Surrogate,
    curve_surrogate,
    diffuse_surrogate,
    prepare_geometry,
    refiltered,
)
from trompe_server.surrogate.tone import Ask, ToneMap, measure_tone_map
from trompe_shared.api import SurrogateModel
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D
from trompe_shared.opacity import opacity_of

CALIBRATED_GREYS: Final = (0, 128)
CURVE_GREYS: Final = (0, 64, 128, 191, 255)
"""Encoded greys of the probes of the ``calibrated`` and the ``curve`` model. White alone would saturate."""

NOISE_AMPLITUDE: Final = 0.1

NOISE_FINENESS: Final = 3.0
"""Fewest squares of a random repaint along a pixel once they hold several texels: a pixel averages them, and of six it
shows two levels, from which rounding takes a part."""

TRIAL_VIEWS: Final = 4
"""Number of views for trying hypotheses and colour models."""

GOLDEN: Final = 0.618034
"""Golden ratio: the fractional parts of its multiples are spread evenly, however many they are."""

KEPT_BYTES: Final = 2**29
"""Bytes of operators kept from earlier hypotheses."""

KEPT_RASTERS: Final = 2
"""The best hypothesis and the one that is tried."""


def painted_grey(obj: Object3D, grey: int) -> Object3D:
    """``obj`` with every albedo texture replaced by one grey (encoded, 0..255); alpha stays."""
    return obj.with_textures(
        {
            name: np.full(
                (4, 4, 3) if opacity_of(obj.files[name], blended=True) is None else image.shape,  # scaled alpha rings
                grey,
                dtype=np.uint8,
            )
            for name, image in obj.textures.items()
        }
    )


def painted_noise(
    obj: Object3D, generator: np.random.Generator, *, footprint: Mapping[str, float] | None = None
) -> Object3D:
    """``obj`` with random +-0.1 (sRGB) added to every channel of every texel.

    footprint: texels that a pixel reads of each texture. Squares of texels change together where these are many.
    """
    reach, reads = round(NOISE_AMPLITUDE * 255), footprint or {}

    def noise(size: tuple[int, ...], side: int) -> NDArray[np.int16]:
        height, width = size
        squares = generator.choice([-reach, reach], (-(-height // side), -(-width // side), 3)).astype(np.int16)
        return squares.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]

    return obj.with_textures(
        {
            name: np.clip(image + noise(image.shape[:2], _side(reads.get(name, 1.0))), 0, 255).astype(np.uint8)
            for name, image in obj.textures.items()
        }
    )


def _side(footprint: float) -> int:
    """Side of the squares: a power of two."""
    return 1 << max(0, math.floor(math.log2(math.sqrt(footprint) / NOISE_FINENESS)))


Score = Callable[[SamplingModel], float]


def find_sampling(score: Score) -> SamplingModel:
    """Search the sampling hypothesis with the highest ``score`` (``Fidelity.score``).

    Coordinate ascent over groups of members, the most informative first, until a whole round changes nothing; a change
    must gain 0.002. Rare practices are tried only if much stays unexplained. Last, a parabola through three scores
    gives the bias of the level of detail.
    """
    scored = lru_cache(maxsize=None)(score)
    best = _climbed(SamplingModel(), scored)
    for _ in range(MAX_RARE):
        if scored(best) >= SATISFYING:
            break
        leader = max((best.but(**members) for members in RARE), key=scored)
        if scored(leader) <= scored(best) + CLEARLY:
            break
        best = _centred(_climbed(_centred(leader, scored), scored), scored)
    return _peaked(best, _biased, BIAS_STEP, scored)


def find_physics(best: SamplingModel, score: Score, groups: Sequence["Group"]) -> SamplingModel:
    """Search beyond rasterisers from ``best``: ``groups`` of ``BEYOND``; every change must gain ``CLEARLY``.

    A missed tone curve or reconstruction filter also misleads the search before it: each is tried on the defaults, too.
    """
    for _ in range(MAX_ROUNDS):
        before = best
        for group in groups:
            tried = [best.but(**members) for members in group]
            if group is TONES:
                kept = {name: getattr(best, name) for name in ("slope", "edges")}
                tried += [_climbed(SamplingModel(**kept).but(**members), score) for members in group]
            leader = max(tried, key=score)
            best = leader if score(leader) > score(best) + CLEARLY else best
        if best == before:
            break
        best = _peaked(_climbed(best, score), _biased, BIAS_STEP, score)
    return best


def _climbed(best: SamplingModel, score: Score) -> SamplingModel:
    """The best hypothesis reachable from ``best`` by changing one group of members at a time."""
    groups = FILTERED if best.samples == "grid" else ALTERNATIVES if best.anisotropy == 1 else ELONGATED
    if best.minified != "mipmaps":
        groups = tuple(group for group in groups if not group[0].keys() & {"lod", "bias"})
    for _ in range(MAX_ROUNDS):
        before = best
        for group in groups:
            tried = [best.but(**members) for members in group]
            leader = max([_uphill(each, score) for each in tried] if group is LEVELS else tried, key=score)
            best = leader if score(leader) > score(best) + 0.002 else best
        if best == before:
            break
    return best


def _uphill(model: SamplingModel, score: Score) -> SamplingModel:
    """``model`` with the bias at which the score falls on both sides: it has one peak."""
    biases = sorted({*BIASES, model.bias})
    for way in (biases, biases[::-1]):
        for bias in way[way.index(model.bias) + 1 :]:
            if score(further := model.but(bias=bias)) <= score(model):
                break
            model = further
    return model


MAX_ROUNDS: Final = 4

SATISFYING: Final = 0.93
"""Score that ends the search before rare practices."""

CLEARLY: Final = 0.02
"""Gain required of a rare practice."""

BIASES: Final = (0.0, -0.25, 0.25, -0.5, 0.5, -1.0, 1.0)

Group = tuple[dict[str, object], ...]

LEVELS: Final[Group] = {"lod": "longer"}, {"lod": "area"}
"""Formulas for the level of detail; each is tried with its best bias."""

ALTERNATIVES: Final[tuple[Group, ...]] = (
    ({"encoding": "srgb"}, {"encoding": "power"}),
    ({"filtered": "encoded"}, {"filtered": "linear"}),
    ({"samples": "msaa4"}, {"samples": "msaa4-mirrored"}, {"samples": "centre"}),
    LEVELS,
    ({"mips": "exact"}, {"mips": "rounded"}),
    ({"shade_at": "centre"}, {"shade_at": "centroid"}),
    ({"cull": True}, {"cull": False}),
)
"""Groups of members that can compensate for each other, with their possible values."""

ELONGATED: Final[tuple[Group, ...]] = (
    tuple({"anisotropy": most} for most in (2, 4, 8, 16)),
    tuple({"bias": bias} for bias in BIASES),
    *(group for group in ALTERNATIVES if group is not LEVELS),
)
"""The same for anisotropic filters."""

SHIFTS: Final[Group] = tuple({"shift": shift} for shift in product((-0.25, 0.0, 0.25), repeat=2) if any(shift))

UNIFORM: Final[dict[str, object]] = {"anisotropy": 1, "elongated": "probes", "lod": "longer", "shade_at": "centre"}

PLAIN_LEVEL: Final[dict[str, object]] = {"lod": "longer", "bias": 0.0, "shade_at": "centre"}
"""Members that compensate for a missed anisotropy; reset for a trial of it."""

RARE: Final[Group] = (
    {"anisotropy": 2, "elongated": "probes", **PLAIN_LEVEL},
    {"anisotropy": 4, "elongated": "probes", **PLAIN_LEVEL},
    {"anisotropy": 16, "elongated": "probes", **PLAIN_LEVEL},
    {"anisotropy": 16, "elongated": "ellipse", **PLAIN_LEVEL},
    *SHIFTS,
)
"""Starting points of the search among rare practices."""

SUB_PIXELS: Final[dict[str, object]] = {"samples": "grid", "filtered": "linear", **UNIFORM, "bias": -0.5}

KERNELS: Final[Group] = tuple(
    SUB_PIXELS | {"kernel": kernel}
    for kernel in (
        ("box", 1.0),
        ("tent", 2.0),
        ("gaussian", 2.0),
        ("gaussian", 4.0),
        ("blackman-harris", 1.5),
        ("blackman-harris", 3.0),
        ("blackman-harris", 4.0),
    )
)
"""Averages of sub-pixels; a texture is read at their size, half a level finer."""

FILTERED: Final[tuple[Group, ...]] = (
    tuple({"bias": bias} for bias in (-1.0, -0.5, 0.0)),
    ({"filtered": "encoded"}, {"filtered": "linear"}),
    ({"encoding": "srgb"}, {"encoding": "power"}),
    ({"cull": True}, {"cull": False}),
)
"""What is left to try under a reconstruction filter."""

SLOPES: Final[Group] = ({"slope": "greys"}, {"slope": "chord"})

EDGES: Final[Group] = ({"edges": "encoded"}, {"edges": "linear"})

TONES: Final[Group] = ({"encoding": "measured"},)

BEYOND: Final[tuple[Group, ...]] = (SLOPES, EDGES, KERNELS)
"""What path tracers do; it costs no image."""

FINEST: Final[Group] = tuple(
    {"minified": minified, **UNIFORM, "bias": 0.0, **seen}
    for minified in ("linear", "nearest")
    for seen in ({}, {"samples": "centre", "slope": "greys", "edges": "encoded"})
)
"""Textures without mip levels: ray casters, VTK by default; from the hypothesis before, and as a plain rasteriser."""

MAX_RARE: Final = 2
"""Most rare practices of one renderer."""

BIAS_STEP: Final = 0.25

SHIFT_STEPS: Final = (0.25, 0.125)


def _biased(model: SamplingModel, by: float) -> SamplingModel:
    return model.but(bias=round(model.bias + by, 4))


def _shifted(model: SamplingModel, by: float, *, axis: int) -> SamplingModel:
    shift = list(model.shift)
    shift[axis] = round(min(1.0, max(-1.0, shift[axis] + by)), 4)
    return model.but(shift=tuple(shift))


def _centred(best: SamplingModel, score: Score) -> SamplingModel:
    """``best`` with its pixel shift, if any, refined by parabolas of decreasing step."""
    for step in SHIFT_STEPS if any(best.shift) else ():
        for axis in range(2):
            best = _peaked(best, partial(_shifted, axis=axis), step, score)
    return best


def _peaked(
    best: SamplingModel, moved: Callable[[SamplingModel, float], SamplingModel], step: float, score: Score
) -> SamplingModel:
    """``best`` moved to the peak of the parabola through its score and its neighbours', if that gains.

    Without a peak it moves one step uphill.
    """
    low, high = (score(moved(best, by)) for by in (-step, step))
    bend = 2 * score(best) - low - high
    ahead = (high - low) / (2 * bend) if bend > 1e-9 else np.sign(high - low)
    fine = moved(best, min(1.0, max(-1.0, float(ahead))) * step)
    return fine if score(fine) > score(best) + 0.0005 else best


@dataclass(frozen=True)
class Calibration:
    """The result of a calibration for one object and its views: everything needed to build the surrogate.

    greys, probes: as for ``curve_surrogate`` (empty for ``diffuse``). fidelity: measured on the trial views. renders:
    number of images rendered in the target. tone: the measured tone curve, if ``sampling`` uses one. noise: root mean
    square of the target's noise on the object, sRGB in [0, 1] units; 0 for a deterministic target.
    """

    model: str
    reason: str
    sampling: SamplingModel
    greys: tuple[int, ...]
    probes: Image8
    fidelity: Fidelity
    renders: int
    tone: ToneMap | None = None
    noise: float = 0.0


def build_surrogate(
    calibration: Calibration,
    obj: Object3D,
    views: Sequence[View],
    clean: Image8,
    *,
    geometry: Geometry | None = None,
    backdrops: Mapping[str, Image8] = NO_BACKDROPS,
    device: torch.device | str = "cpu",
) -> Surrogate:
    """Build the surrogate for ``views`` with the target images ``clean`` (views, H, W, 3) uint8.

    geometry: the result of ``prepare_geometry`` for the same views, if available. backdrops: as for
    ``diffuse_surrogate``.
    """
    if geometry is None:
        size = (clean.shape[1], clean.shape[2])
        geometry = prepare_geometry(obj, views, size=size, sampling=calibration.sampling, device=device)
    if calibration.model == "diffuse":
        return diffuse_surrogate(geometry, views, backdrops=backdrops)
    greys, probes, tone = calibration.greys, calibration.probes, calibration.tone
    return curve_surrogate(geometry, obj, views, clean, greys, probes, tone=tone, backdrops=backdrops)


def calibrate(
    obj: Object3D,
    views: Sequence[View],
    clean: Image8,
    ask: Ask,
    *,
    wanted: SurrogateModel,
    generator: np.random.Generator,
    backdrops: Mapping[str, Image8] = NO_BACKDROPS,
    on_sampling: Callable[[SamplingModel], None] = lambda _: None,
    deterministic: bool = True,
    device: torch.device | str = "cpu",
) -> Calibration:
    """Probe the target as far as the ``wanted`` colour model needs; ``auto`` takes the cheapest within tolerance.

    Otherwise ``auto`` takes the best: the two probes under other shading, filters and tone curves, or five probes.

    clean: the target's images of ``obj``, (views, H, W, 3) uint8. on_sampling: receives the sampling model as soon as
    it is known, before most of the probes. deterministic: equal views give equal images whatever the number of their
    noise; otherwise the noise is measured. All images of a view share it, so that they differ by the paint alone.
    A few trial views decide; the other views are probed afterwards. Raises ``RendererError`` for images of another
    shape or type.
    """
    clean, renders = _checked(clean, views, size=clean.shape[1:3]), 0

    def asked(painted: Object3D, some: Sequence[View]) -> Image8:
        nonlocal renders
        renders += len(some)
        return _checked(ask(painted, some), some, size=clean.shape[1:3])

    trial = _Trial(
        *(obj, views, clean, asked, generator, backdrops), deterministic=deterministic, device=torch.device(device)
    )
    if wanted in {"auto", "diffuse"}:
        fidelity = trial.fidelity(SamplingModel(), ())
        if wanted == "diffuse" or fidelity.good_enough:
            reason = "requested" if wanted == "diffuse" else f"good enough without probes: {_summary(fidelity)}"
            nothing = np.zeros((0, *clean.shape), np.uint8)
            return Calibration("diffuse", reason, SamplingModel(), (), nothing, fidelity, renders, noise=trial.noise)
    model, reason, sampling, fidelity = _chosen(trial, wanted)
    on_sampling(sampling)
    greys = CALIBRATED_GREYS if model == "calibrated" else CURVE_GREYS
    probes = np.stack([trial.probe_all(grey, views) for grey in greys])
    tone = trial.tone if sampling.encoding == "measured" else None
    return Calibration(model, reason, sampling, greys, probes, fidelity, renders, tone, trial.noise)


def _checked(images: Image8, views: Sequence[View], *, size: tuple[int, ...]) -> Image8:
    expected = (len(views), *size, 3)
    if images.shape != expected or images.dtype != np.uint8:
        raise RendererError(
            f"The target gave images of shape {images.shape} and type {images.dtype}; expected {expected}, "
            "(views, H, W, 3), and uint8, sRGB."
        )
    return np.ascontiguousarray(images)


class _Trial:
    """The trial views and the target's images of them: unpainted, repainted at random, and in greys on demand.

    again: unpainted with other noise; ``None`` for a deterministic target. probes: images so far, by grey. geometries:
    of recent hypotheses; hypotheses with the same geometry share one. visible: triangles of the ``KEPT_RASTERS`` most
    recent rasterisations, by the members that change them.
    """

    def __init__(
        self,
        obj: Object3D,
        views: Sequence[View],
        clean: Image8,
        ask: Ask,
        generator: np.random.Generator,
        backdrops: Mapping[str, Image8],
        *,
        deterministic: bool,
        device: torch.device,
    ) -> None:
        self.obj, self.ask, self.backdrops, self.device = obj, ask, backdrops, device
        self.index = _from_all_sides([view.camera for view in views])
        self.views, self.clean = tuple(views[k] for k in self.index), clean[self.index]
        self.probes: dict[int, Image8] = {}
        self.geometries: dict[SamplingModel, Geometry] = {}
        self.visible = lru_cache(maxsize=KEPT_RASTERS)(_nothing_yet)
        footprint = diffuse_surrogate(self._geometry(SamplingModel()), self.views, backdrops=backdrops).footprint
        repainted = painted_noise(obj, generator, footprint=footprint)
        self.images = ask(repainted, self.views)
        self.again = None if deterministic else ask(obj, [replace(view, noise=view.noise + 1) for view in self.views])
        self.painted = Painted(obj, device), Painted(repainted, device)

    @cached_property
    def tone(self) -> ToneMap:
        """The target's tone curve; measured when it is first asked for."""
        return measure_tone_map(self.ask, (self.clean.shape[1], self.clean.shape[2]))

    @cached_property
    def noise(self) -> float:
        """Root mean square of the noise of one image on pixels that the random repaint changes."""
        if self.again is None:
            return 0.0
        changed = (self.images != self.clean).any(axis=3)
        difference = (self.again[changed].astype(np.float64) - self.clean[changed]) / 255
        return float(np.sqrt(np.square(difference).mean() / 2)) if len(difference) else 0.0

    def probe(self, grey: int) -> Image8:
        """Images of the trial views with the object painted in ``grey``."""
        if grey not in self.probes:
            self.probes[grey] = self.ask(painted_grey(self.obj, grey), self.views)
        return self.probes[grey]

    def probe_all(self, grey: int, views: Sequence[View]) -> Image8:
        """Images of all ``views`` with the object painted in ``grey``; reuses the trial views."""
        others = [k for k in range(len(views)) if k not in self.index]
        images = np.zeros((len(views), *self.clean.shape[1:]), np.uint8)
        images[self.index] = self.probe(grey)
        if others:
            images[others] = self.ask(painted_grey(self.obj, grey), [views[k] for k in others])
        return images

    def fidelity(self, sampling: SamplingModel, greys: tuple[int, ...]) -> Fidelity:
        """Fidelity of the colour model of some greys under a sampling hypothesis, on the trial views."""
        unpainted, repainted = self.painted
        geometry = replace(self._geometry(sampling), sampling=sampling)
        if greys:
            probes = np.stack([self.probe(grey) for grey in greys])
            tone = self.tone if sampling.encoding == "measured" else None
            surrogate = curve_surrogate(
                geometry, unpainted, self.views, self.clean, greys, probes, tone=tone, backdrops=self.backdrops
            )
        else:
            surrogate = diffuse_surrogate(geometry, self.views, backdrops=self.backdrops)
        return measure_fidelity(surrogate, unpainted, self.clean, repainted, self.images)

    def _geometry(self, sampling: SamplingModel) -> Geometry:
        key = sampling.but(**{name: getattr(SamplingModel(), name) for name in (*_COLOURS, "kernel")})
        size = (self.clean.shape[1], self.clean.shape[2])
        known = self.geometries.pop(key, None)
        made, seen = key.but(kernel=sampling.kernel), (sampling.samples, sampling.shift, sampling.cull)
        self.geometries[key] = known or prepare_geometry(
            self.obj, self.views, size=size, sampling=made, device=self.device, known=self.visible(*seen)
        )
        while len(self.geometries) > 1 and sum(each.nbytes for each in self.geometries.values()) > KEPT_BYTES:
            del self.geometries[next(iter(self.geometries))]
        found = self.geometries[key]
        return found if found.sampling.kernel == sampling.kernel else refiltered(found, sampling.kernel)


def _nothing_yet(*_members: object) -> dict[Camera, Visibility]:
    return {}


def _from_all_sides(cameras: Sequence[Camera]) -> list[int]:
    """Indices of ``TRIAL_VIEWS`` of the ``cameras``, or of all if they are fewer, ascending.

    One from each part of the azimuths, each at another elevation: even steps through a grid would meet one column only.
    """
    around = sorted(range(len(cameras)), key=lambda k: cameras[k].azimuth % 360)
    chosen = []
    for number, part in enumerate(np.array_split(around, min(TRIAL_VIEWS, len(cameras))), 1):
        upwards = sorted(part.tolist(), key=lambda k: cameras[k].elevation)
        chosen.append(upwards[int(number * GOLDEN % 1 * len(upwards))])
    return sorted(chosen)


_COLOURS: Final = ("encoding", "filtered", "mips", "slope", "edges")
"""Members of a hypothesis that its geometry does not depend on."""


def _chosen(trial: _Trial, wanted: SurrogateModel) -> tuple[str, str, SamplingModel, Fidelity]:
    """(model, reason, sampling, fidelity): the wanted model, or with ``auto`` the cheapest within tolerance.

    Without one within tolerance it is the best.
    """

    @cache
    def two(sampling: SamplingModel) -> Fidelity:
        return trial.fidelity(sampling, CALIBRATED_GREYS)

    def score(sampling: SamplingModel) -> float:
        return two(sampling).score

    plain = find_sampling(score)
    if wanted == "curve":
        return "curve", "requested", plain, trial.fidelity(plain, CURVE_GREYS)
    traced = trial.again is not None  # who draws random light paths bounces light and filters pixels
    sampling = find_physics(plain, score, BEYOND) if traced or score(plain) < SATISFYING else plain
    if _wrong_colours(two(sampling)):
        sampling = find_physics(sampling, score, (TONES, *BEYOND))
    if not two(sampling).good_enough and (finest := find_physics(sampling, score, (FINEST,))) != sampling:
        sampling = find_physics(finest, score, (TONES, *BEYOND))
    fidelity = two(sampling)
    told = _summary(fidelity) + _practices(sampling)
    if wanted == "calibrated":
        return "calibrated", f"requested{_practices(sampling)}", sampling, fidelity
    if fidelity.good_enough:
        return "calibrated", f"good enough with two probes a view: {told}", sampling, fidelity
    five = trial.fidelity(plain, CURVE_GREYS)
    if five.score > fidelity.score + CLEARLY:
        reason = f"two probes a view are not enough ({told}); with five: {_summary(five)}"
        return "curve", reason, plain, five
    return "calibrated", f"two probes a view: {told}; five are no better: {_summary(five)}", sampling, fidelity


def _wrong_colours(fidelity: Fidelity) -> bool:
    """Whether a tone curve is worth its images: out of tolerance, or changes are predicted too large or too small."""
    steep = abs(fidelity.mean()["slope"] - 1) > MAX_STEEPNESS
    return not fidelity.good_enough or (steep and fidelity.score < SATISFYING)


MAX_STEEPNESS: Final = 0.1


def _summary(fidelity: Fidelity) -> str:
    mean = fidelity.mean()
    return f"error {mean['error'] * 255:.1f}/255, {mean['explained']:.0%} of a random repaint's effect explained"


def _practices(sampling: SamplingModel) -> str:
    """What ``find_physics`` found, as the end of a phrase."""
    kernel, width = sampling.kernel
    practices = {
        "a measured tone curve": sampling.encoding == "measured",
        "the chord to the unpainted object": sampling.slope == "chord",
        "edges averaged in light": sampling.edges == "linear",
        f"a {kernel} filter of {width:g} pixels": sampling.samples == "grid",
        "textures without mip levels": sampling.minified != "mipmaps",
    }
    used = [name for name, does in practices.items() if does]
    return f", with {' and '.join(used)}" if used else ""
