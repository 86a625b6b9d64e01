"""Finding out, by images alone, how the target samples textures and how little of a colour model the scene needs.

The target stays a black box: it is shown the object painted in greys and in random noise, and every hypothesis is
judged by how well it predicts what the noise changes in the target's images.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.surrogate.fidelity import Fidelity, measure_fidelity
from trompe_server.surrogate.sampling import SamplingModel
from trompe_server.surrogate.surrogate import (
    NO_BACKDROPS,
    Geometry,
    Surrogate,
    curve_surrogate,
    diffuse_surrogate,
    prepare_geometry,
)
from trompe_shared.api import SurrogateModel
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D
from trompe_shared.opacity import opacity_of

__all__ = [
    "CALIBRATED_GREYS",
    "CURVE_GREYS",
    "Calibration",
    "build_surrogate",
    "calibrate",
    "find_sampling",
    "painted_grey",
    "painted_noise",
]

CALIBRATED_GREYS: Final = (0, 128)
CURVE_GREYS: Final = (0, 64, 128, 191, 255)
"""Encoded greys of the probes of the ``calibrated`` and the ``curve`` model. White would saturate and tell little."""

NOISE_AMPLITUDE: Final = 0.1

TRIAL_VIEWS: Final = 4
"""Views on which hypotheses and colour models are tried."""

KEPT_BYTES: Final = 2**29
"""Memory of the operators of hypotheses that are kept while others are tried."""

Image8 = NDArray[np.uint8]
Ask = Callable[[Object3D, Sequence[View]], Image8]
"""Asks the target for images: (views, H, W, 3) uint8."""


def painted_grey(obj: Object3D, grey: int) -> Object3D:
    """``obj`` with every albedo texture replaced by one uniform grey (encoded, 0..255); what is cut out stays so."""
    return obj.with_textures(
        {
            name: np.full((4, 4, 3) if opacity_of(obj.files[name]) is None else image.shape, grey, dtype=np.uint8)
            for name, image in obj.textures.items()
        }
    )


def painted_noise(obj: Object3D, generator: np.random.Generator) -> Object3D:
    """``obj`` with +-0.1 (sRGB) added at random to every channel of every texel."""
    reach = round(NOISE_AMPLITUDE * 255)
    return obj.with_textures(
        {
            name: np.clip(image + generator.choice([-reach, reach], image.shape), 0, 255).astype(np.uint8)
            for name, image in obj.textures.items()
        }
    )


Score = Callable[[SamplingModel], float]


def find_sampling(score: Score) -> SamplingModel:
    """The sampling hypothesis with the highest ``score`` (``Fidelity.score``).

    One group of members is varied at a time, the most telling first, until a whole round changes nothing; a change
    must gain 0.002 to be believed. Only where that leaves much unexplained, what few renderers do is tried too. At the
    end the bias of the level of detail is read off a parabola.
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


def _climbed(best: SamplingModel, score: Score) -> SamplingModel:
    """The best that can be reached from ``best`` by changing one group of members at a time."""
    for _ in range(MAX_ROUNDS):
        before = best
        for group in ALTERNATIVES if best.anisotropy == 1 else ELONGATED:
            leader = max((best.but(**members) for members in group), key=score)
            best = leader if score(leader) > score(best) + 0.002 else best
        if best == before:
            break
    return best


MAX_ROUNDS: Final = 4

SATISFYING: Final = 0.93
"""Score from which on nothing rare is looked for."""

CLEARLY: Final = 0.02
"""What something rare must gain."""

BIASES: Final = (0.0, -0.25, 0.25, -0.5, 0.5, -1.0, 1.0)

Group = tuple[dict[str, object], ...]

LEVELS: Final[Group] = tuple({"lod": lod, "bias": bias} for lod in ("longer", "area") for bias in BIASES)

ALTERNATIVES: Final[tuple[Group, ...]] = (
    ({"encoding": "srgb"}, {"encoding": "power"}),
    ({"filtered": "encoded"}, {"filtered": "linear"}),
    ({"samples": "msaa4"}, {"samples": "msaa4-mirrored"}, {"samples": "centre"}),
    LEVELS,
    ({"mips": "exact"}, {"mips": "rounded"}),
    ({"shade_at": "centre"}, {"shade_at": "centroid"}),
    ({"cull": True}, {"cull": False}),
)
"""Groups of members of the hypothesis that make up for each other, and the values they could have."""

ELONGATED: Final[tuple[Group, ...]] = (
    tuple({"anisotropy": most} for most in (2, 4, 8, 16)),
    tuple({"bias": bias} for bias in BIASES),
    *(group for group in ALTERNATIVES if group is not LEVELS),
)
"""The same for filters that follow elongated footprints."""

SHIFTS: Final[Group] = tuple({"shift": shift} for shift in product((-0.25, 0.0, 0.25), repeat=2) if any(shift))

PLAIN_LEVEL: Final[dict[str, object]] = {"lod": "longer", "bias": 0.0, "shade_at": "centre"}
"""What else makes up for anisotropy that is missed."""

RARE: Final[Group] = (
    {"anisotropy": 2, "elongated": "probes", **PLAIN_LEVEL},
    {"anisotropy": 4, "elongated": "probes", **PLAIN_LEVEL},
    {"anisotropy": 16, "elongated": "probes", **PLAIN_LEVEL},
    {"anisotropy": 16, "elongated": "ellipse", **PLAIN_LEVEL},
    *SHIFTS,
)
"""Where a search for what few renderers do begins."""

MAX_RARE: Final = 2
"""How many things that few renderers do one renderer may do."""

BIAS_STEP: Final = 0.25

SHIFT_STEPS: Final = (0.25, 0.125)


def _biased(model: SamplingModel, by: float) -> SamplingModel:
    return model.but(bias=round(model.bias + by, 4))


def _shifted_right(model: SamplingModel, by: float) -> SamplingModel:
    return model.but(shift=(round(min(1.0, max(-1.0, model.shift[0] + by)), 4), model.shift[1]))


def _shifted_down(model: SamplingModel, by: float) -> SamplingModel:
    return model.but(shift=(model.shift[0], round(min(1.0, max(-1.0, model.shift[1] + by)), 4)))


def _centred(best: SamplingModel, score: Score) -> SamplingModel:
    """``best`` with the shift of its pixels read off parabolas, ever finer; as it is where it has none."""
    for step in SHIFT_STEPS if any(best.shift) else ():
        best = _peaked(_peaked(best, _shifted_right, step, score), _shifted_down, step, score)
    return best


def _peaked(
    best: SamplingModel, moved: Callable[[SamplingModel, float], SamplingModel], step: float, score: Score
) -> SamplingModel:
    """``best`` moved to where the parabola through its own and two neighbouring scores peaks, if that gains.

    A step further uphill, where they are no peak.
    """
    low, high = (score(moved(best, by)) for by in (-step, step))
    bend = 2 * score(best) - low - high
    ahead = (high - low) / (2 * bend) if bend > 1e-9 else np.sign(high - low)
    fine = moved(best, min(1.0, max(-1.0, float(ahead))) * step)
    return fine if score(fine) > score(best) + 0.0005 else best


@dataclass(frozen=True)
class Calibration:
    """What was found out about the target for one object and its views: all that the surrogate is built from.

    greys and probes as ``curve_surrogate`` takes them (empty for ``diffuse``). fidelity: measured on the trial views.
    renders: how many images the target was asked for.
    """

    model: str
    reason: str
    sampling: SamplingModel
    greys: tuple[int, ...]
    probes: Image8
    fidelity: Fidelity
    renders: int


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
    """The surrogate for ``views``, whose target images are ``clean``.

    ``geometry``: what ``prepare_geometry`` made of the same, where that has been done. ``backdrops`` as for
    ``diffuse_surrogate``.
    """
    if geometry is None:
        size = (clean.shape[1], clean.shape[2])
        geometry = prepare_geometry(obj, views, size=size, sampling=calibration.sampling, device=device)
    return _shaded(calibration, geometry, obj, views, clean, backdrops)


def _shaded(
    calibration: Calibration,
    geometry: Geometry,
    obj: Object3D,
    views: Sequence[View],
    clean: Image8,
    backdrops: Mapping[str, Image8],
) -> Surrogate:
    """The surrogate on a geometry that stands already."""
    if calibration.model == "diffuse":
        return diffuse_surrogate(geometry, views, backdrops=backdrops)
    greys, probes = calibration.greys, calibration.probes
    return curve_surrogate(geometry, obj, views, clean, greys, probes, backdrops=backdrops)


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
) -> Calibration:
    """Probe the target as little as the ``wanted`` colour model needs; ``auto`` takes the cheapest that is good enough.

    ``clean`` are the target's images of ``obj``, (views, H, W, 3) uint8. A few trial views decide; only then are all of
    them probed. ``on_sampling`` is told the sampling model as soon as it is known, before most of the probes.
    """
    trial = _Trial.of(obj, views, clean, ask, generator, backdrops)
    if wanted in {"auto", "diffuse"}:
        fidelity = trial.fidelity("diffuse", SamplingModel(), ())
        if wanted == "diffuse" or fidelity.good_enough:
            reason = "asked for" if wanted == "diffuse" else f"good enough without probes: {_said(fidelity)}"
            nothing = np.zeros((0, *clean.shape), np.uint8)
            return Calibration("diffuse", reason, SamplingModel(), (), nothing, fidelity, trial.renders)
    sampling = find_sampling(lambda model: trial.fidelity("calibrated", model, CALIBRATED_GREYS).score)
    on_sampling(sampling)
    model, reason, fidelity = _cheapest(trial, sampling, wanted)
    greys = CALIBRATED_GREYS if model == "calibrated" else CURVE_GREYS
    probes = np.stack([trial.probe_all(grey, views) for grey in greys])
    renders = trial.renders + len(greys) * (len(views) - len(trial.views))
    return Calibration(model, reason, sampling, greys, probes, fidelity, renders)


@dataclass(frozen=True)
class _Trial:
    """The trial views, and what the target showed there: unpainted, repainted at random, and in greys as needed."""

    obj: Object3D
    index: tuple[int, ...]
    views: tuple[View, ...]
    clean: Image8
    repainted: Object3D
    images: Image8
    backdrops: Mapping[str, Image8]
    ask: Ask
    probes: dict[int, Image8] = field(default_factory=dict)
    """What was asked for so far, by grey."""
    geometries: dict[SamplingModel, Geometry] = field(default_factory=dict)
    """Under the hypotheses that were tried last; those that differ in colours alone share one."""

    @classmethod
    def of(
        cls,
        obj: Object3D,
        views: Sequence[View],
        clean: Image8,
        ask: Ask,
        generator: np.random.Generator,
        backdrops: Mapping[str, Image8],
    ) -> "_Trial":
        index = tuple(sorted({round(k) for k in np.linspace(0, len(views) - 1, TRIAL_VIEWS + 2)[1:-1]}))
        few = tuple(views[k] for k in index)
        repainted = painted_noise(obj, generator)
        return cls(obj, index, few, clean[list(index)], repainted, ask(repainted, few), backdrops, ask)

    @property
    def renders(self) -> int:
        return len(self.views) * (1 + len(self.probes))

    def probe(self, grey: int) -> Image8:
        """The trial views painted in a grey."""
        if grey not in self.probes:
            self.probes[grey] = self.ask(painted_grey(self.obj, grey), self.views)
        return self.probes[grey]

    def probe_all(self, grey: int, views: Sequence[View]) -> Image8:
        """All ``views`` painted in a grey; the trial views are not asked for again."""
        others = [k for k in range(len(views)) if k not in self.index]
        images = np.zeros((len(views), *self.clean.shape[1:]), np.uint8)
        images[list(self.index)] = self.probe(grey)
        if others:
            images[others] = self.ask(painted_grey(self.obj, grey), [views[k] for k in others])
        return images

    def fidelity(self, model: str, sampling: SamplingModel, greys: tuple[int, ...]) -> Fidelity:
        """Fidelity of a colour model under a sampling hypothesis, on the trial views."""
        probes = np.array([self.probe(grey) for grey in greys], np.uint8).reshape(-1, *self.clean.shape)
        nothing = Fidelity((), (), (), ())
        calibration = Calibration(model, "", sampling, greys, probes, nothing, 0)
        geometry = replace(self._geometry(sampling), sampling=sampling)
        surrogate = _shaded(calibration, geometry, self.obj, self.views, self.clean, self.backdrops)
        return measure_fidelity(surrogate, self.obj, self.clean, self.repainted, self.images)

    def _geometry(self, sampling: SamplingModel) -> Geometry:
        key = sampling.but(**{name: getattr(SamplingModel(), name) for name in ("encoding", "filtered", "mips")})
        size = (self.clean.shape[1], self.clean.shape[2])
        known = self.geometries.pop(key, None)
        self.geometries[key] = known or prepare_geometry(self.obj, self.views, size=size, sampling=key)
        while len(self.geometries) > 1 and sum(each.nbytes for each in self.geometries.values()) > KEPT_BYTES:
            del self.geometries[next(iter(self.geometries))]
        return self.geometries[key]


def _cheapest(trial: _Trial, sampling: SamplingModel, wanted: SurrogateModel) -> tuple[str, str, Fidelity]:
    """(model, why, its fidelity): the wanted one, or with ``auto`` the cheaper of the two if it is good enough."""
    if wanted == "auto":
        fidelity = trial.fidelity("calibrated", sampling, CALIBRATED_GREYS)
        if fidelity.good_enough:
            return "calibrated", f"good enough with two probes a view: {_said(fidelity)}", fidelity
        missed = f"two probes a view are not enough ({_said(fidelity)}); with five: "
        fidelity = trial.fidelity("curve", sampling, CURVE_GREYS)
        return "curve", missed + _said(fidelity), fidelity
    greys = CALIBRATED_GREYS if wanted == "calibrated" else CURVE_GREYS
    return wanted, "asked for", trial.fidelity(wanted, sampling, greys)


def _said(fidelity: Fidelity) -> str:
    mean = fidelity.mean()
    return f"error {mean['error'] * 255:.1f}/255, {mean['explained']:.0%} of a random repaint's effect explained"
