"""Calibration: it finds how a target samples, asks no more than it needs, counts what it asks, and is not fooled."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.attack_runs import default_sampling, surrogate_of
from tests.surfaces import object_of, quad, with_alpha
from trompe_server.attack import grid_views
from trompe_server.renderers import SailenvTarget
from trompe_server.storage.arrays import pack_arrays
from trompe_server.surrogate import SamplingModel, Surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.calibration import (
    CALIBRATED_GREYS,
    CURVE_GREYS,
    FINEST,
    SATISFYING,
    TRIAL_VIEWS,
    Calibration,
    build_surrogate,
    calibrate,
    find_physics,
    find_sampling,
    painted_grey,
    painted_noise,
)
from trompe_server.surrogate.calibration_file import pack_calibration, unpack_calibration
from trompe_server.surrogate.fidelity import MAX_ERROR, MIN_EXPLAINED, Fidelity, measure_fidelity
from trompe_server.surrogate.rasterize import Visibility, rasterize
from trompe_server.surrogate.shading import ENCODERS, decode, encode
from trompe_server.surrogate.tone import ToneMap, measure_tone_map
from trompe_shared.api import SurrogateModel
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, decode_alpha
from trompe_shared.shipped import shipped_objects

SIZE = (64, 64)
MUG = shipped_objects()["mug"]
VIEWS = [View(Camera(MUG.distance, azimuth, elevation)) for azimuth in (0, 70, 200) for elevation in (5, 40)]
Image8 = NDArray[np.uint8]
Render = Callable[[Object3D, Sequence[View]], Image8]


@dataclass
class Asked:
    """Asks ``render``, and keeps in mind how many images of what."""

    render: Render
    images: int = 0
    greys: set[int] = field(default_factory=set)

    def __call__(self, obj: Object3D, views: Sequence[View]) -> Image8:
        self.images += len(views)
        texture = next(iter(obj.textures.values()))
        if (texture == texture[0, 0, 0]).all():
            self.greys.add(int(texture[0, 0, 0]))
        return self.render(obj, views)


@dataclass
class KnownTarget:
    """A target whose true model is known: it samples textures by ``sampling``, and lights them in linear light as a
    renderer does, or (not ``affine``) as the paper's surrogate does.

    film: its tone curve. bounce: light that all surfaces get from each other, as a share of their mean albedo.
    noise: standard deviation, numbered by the views, in 1/255. size: (H, W) of its images.
    """

    sampling: SamplingModel
    affine: bool = True
    film: Callable[[Tensor], Tensor] | None = None
    bounce: float = 0.0
    noise: float = 0.0
    size: tuple[int, int] = SIZE
    known: dict[object, Surrogate] = field(default_factory=dict)

    def __call__(self, obj: Object3D, views: Sequence[View]) -> Image8:
        key = (tuple(views), *(texture.shape for texture in obj.textures.values()))
        if key not in self.known:
            self.known[key] = surrogate_of(obj, views, size=self.size, sampling=self.sampling)
        if not self.affine:
            return self.known[key].images(obj)
        images = self._affine_images(self.known[key], obj, views[0].light.intensity / Light().intensity)
        seeds = [[view.noise, round(view.camera.azimuth) % 360, round(view.camera.elevation) + 90] for view in views]
        grain = np.stack([np.random.default_rng(seed).normal(0, self.noise, (*self.size, 3)) for seed in seeds])
        return np.clip(np.round(images + grain * (images < 255)), 0, 255).astype(np.uint8)

    def _affine_images(self, surrogate: Surrogate, obj: Object3D, intensity: float) -> NDArray[np.float64]:
        images, texels = surrogate.base.numpy().astype(np.float64), surrogate.texels(textures_of(obj))
        film = self.film or ENCODERS["power" if self.sampling.encoding == "power" else "srgb"]
        for batch in surrogate.geometry.batches:
            values = batch.gather.forward(texels)
            albedo = values if self.sampling.filtered == "linear" else decode(values)
            light = intensity * batch.shade * albedo * (1 + self.bounce * albedo.mean())
            behind = 1 - batch.coverage  # white
            linear = self.sampling.edges == "linear"
            colour = film(batch.coverage * light + behind) if linear else batch.coverage * film(light) + behind
            some = images[batch.views.start : batch.views.stop].reshape(-1, 3)
            some[batch.pixel.numpy()] = colour.clamp(0, 1).mul(255).numpy()
        return images


USUAL = KnownTarget(SamplingModel())


def found(
    obj: Object3D, ask: Render, wanted: SurrogateModel, *, views: Sequence[View] = VIEWS, **options: Any
) -> Calibration:
    return calibrate(obj, views, ask(obj, views), ask, wanted=wanted, generator=np.random.default_rng(0), **options)


Usual = Callable[[SurrogateModel], Calibration]


@pytest.fixture(scope="module")
def usual(mug: Object3D) -> Usual:
    """The calibration of the mug in ``USUAL`` for a wanted model, made once."""
    return cache(default_sampling()(lambda wanted: found(mug, USUAL, wanted)))


@pytest.fixture(scope="module")
def busy_mug(mug: Object3D) -> Object3D:
    """The mug with much contrast from texel to texel, where hypotheses differ most."""
    random = np.random.default_rng(0)
    return mug.with_textures({n: random.integers(0, 256, (128, 128, 3), dtype=np.uint8) for n in mug.textures})


@pytest.mark.parametrize(
    "truth",
    [
        pytest.param(SamplingModel(), id="the default"),
        pytest.param(SamplingModel(filtered="linear", lod="area", bias=0.5), id="linear, area, 0.5"),
        pytest.param(SamplingModel(filtered="linear", samples="centre", bias=-0.5), id="linear, centre, -0.5"),
        pytest.param(SamplingModel(lod="area", samples="centre", bias=0.25), id="area, centre, 0.25"),
        pytest.param(SamplingModel(encoding="power", shade_at="centroid"), id="power, centroid"),
        pytest.param(SamplingModel(samples="msaa4-mirrored", mips="rounded"), id="mirrored, rounded"),
    ],
)
def test_the_sampling_of_a_known_target_is_recovered(busy_mug: Object3D, truth: SamplingModel) -> None:
    calibration = found(busy_mug, KnownTarget(truth), "curve")
    for member in ("samples", "shade_at", "lod", "filtered", "encoding", "mips", "cull"):
        assert getattr(calibration.sampling, member) == getattr(truth, member)
    assert calibration.sampling.bias == pytest.approx(truth.bias, abs=0.1)
    assert calibration.fidelity.mean()["explained"] > 0.98
    assert calibration.fidelity.mean()["slope"] == pytest.approx(1, abs=0.03)
    assert calibration.fidelity.mean()["correlation"] > 0.98


def test_hypotheses_of_the_same_triangles_rasterise_once(busy_mug: Object3D, monkeypatch: pytest.MonkeyPatch) -> None:
    clean, counted = USUAL(busy_mug, VIEWS), Mock(side_effect=rasterize)
    monkeypatch.setattr("trompe_server.surrogate.surrogate.rasterize", counted)
    calibrate(busy_mug, VIEWS, clean, USUAL, wanted="auto", generator=np.random.default_rng(0))
    # USUAL's own two geometries; three kinds of samples, both sides of triangles, and the best again after those.
    assert counted.call_count <= TRIAL_VIEWS * (2 + 3 + 1 + 2)


def test_triangles_known_from_another_hypothesis_make_the_same_geometry(mug: Object3D) -> None:
    known: dict[Camera, Visibility] = {}
    for model in (SamplingModel(), SamplingModel(lod="area", bias=0.5), SamplingModel(shade_at="centroid")):
        shared = prepare_geometry(mug, VIEWS, size=SIZE, sampling=model, known=known)
        alone = prepare_geometry(mug, VIEWS, size=SIZE, sampling=model)
        for one, other in zip(shared.batches, alone.batches, strict=True):
            texels = torch.rand(sum(map(len, alone.reads)), 3, generator=torch.Generator().manual_seed(0))
            assert torch.equal(one.gather.forward(texels), other.gather.forward(texels))
            assert torch.equal(one.pixel, other.pixel)
    assert len(known) == len({view.camera for view in VIEWS})


def test_a_view_in_which_hardly_anything_changes_does_not_outweigh_all_others(mug: Object3D, usual: Usual) -> None:
    """As in the dark: a single pixel becomes lighter by one of 255, and all else is predicted rightly."""
    clean = USUAL(mug, VIEWS)
    surrogate = build_surrogate(usual("calibrated"), mug, VIEWS, clean)
    images = clean.copy()
    images[1, SIZE[0] // 2, SIZE[1] // 2] += 1
    fidelity = measure_fidelity(surrogate, mug, clean, mug, images)
    assert len(fidelity.explained) == 1
    assert fidelity.explained[0] > -1


grid = partial(grid_views, distance=0.3, elevation=(0, 50), background=(255, 255, 255))
BOTH_SIDES = [View(Camera(0.4, azimuth, 10)) for azimuth in (0, 40, 180, -40, 200, 160)]


@pytest.mark.parametrize("views", [BOTH_SIDES, grid(azimuths=None, elevations=10)], ids=["few", "paper's grid"])
def test_a_target_that_shows_both_sides_of_a_sheet_is_understood(views: Sequence[View]) -> None:
    texture = np.random.default_rng(0).integers(40, 216, (96, 96, 3), dtype=np.uint8)
    truth = SamplingModel(cull=False)
    calibration = found(object_of(quad(texture)), KnownTarget(truth), "curve", views=views)
    assert calibration.sampling == truth
    assert len(calibration.fidelity.correlation) == 4
    assert min(calibration.fidelity.correlation) > 0.98


@pytest.mark.parametrize(("azimuths", "elevations"), [(None, 10), (None, 8), (3, 13), (5, 5), (8, 8), (12, 1)])
def test_trial_views_look_from_all_sides_of_a_grid(mug: Object3D, azimuths: int | None, elevations: int) -> None:
    trial: list[View] = []

    def ask(_: Object3D, views: Sequence[View]) -> Image8:
        trial.extend(views)
        return np.zeros((len(views), *SIZE, 3), np.uint8)

    views = grid(azimuths=azimuths, elevations=elevations)
    calibrate(mug, views, ask(mug, views), ask, wanted="diffuse", generator=np.random.default_rng(0))
    cameras = [view.camera for view in trial[len(views) :]]
    assert len(cameras) == TRIAL_VIEWS
    around = sorted(camera.azimuth % 360 for camera in cameras)
    assert np.diff([*around, around[0] + 360]).max() <= 180
    assert np.ptp([camera.elevation for camera in cameras]) >= (20 if elevations > 1 else 0)


def test_what_changes_where_the_surrogate_sees_no_object_counts_against_it(mug: Object3D, usual: Usual) -> None:
    noise = painted_noise(mug, np.random.default_rng(1))
    surrogate = build_surrogate(usual("calibrated"), mug, VIEWS, USUAL(mug, VIEWS))
    clean, images = USUAL(mug, VIEWS), USUAL(noise, VIEWS)
    honest = measure_fidelity(surrogate, mug, clean, noise, images)
    images[1, :8], clean[1, :8] = images[1, 28:36], clean[1, 28:36]  # a reflection
    fooled = measure_fidelity(surrogate, mug, clean, noise, images)
    assert honest.good_enough
    for name in ("correlation", "explained"):
        one, other = getattr(honest, name), getattr(fooled, name)
        assert other[1] < one[1] - 0.05
        assert (other[0], *other[2:]) == (one[0], *one[2:])
    assert fooled.error == honest.error


def test_a_texture_far_finer_than_pixels_is_calibrated_as_well_and_as_cheaply(mug: Object3D, usual: Usual) -> None:
    """Noise of single texels would hardly show in 8 bits."""
    finer = {name: image.repeat(4, axis=0).repeat(4, axis=1) for name, image in mug.textures.items()}
    fine, coarse = found(mug.with_textures(finer), USUAL, "auto"), usual("auto")
    assert (fine.sampling, fine.renders, fine.model) == (coarse.sampling, coarse.renders, coarse.model)
    assert fine.fidelity.mean()["explained"] > 0.97


@pytest.mark.parametrize("wanted", ["auto", "diffuse", "curve"])
def test_of_views_that_all_see_nothing_nothing_good_is_said(wanted: SurrogateModel) -> None:
    obj = object_of(quad(np.full((8, 8, 3), 128, np.uint8)))
    calibration = found(obj, USUAL, wanted, views=[View(Camera(0.5, 180, 0))] * 2)
    assert calibration.fidelity == Fidelity((0.0,), (0.0,), (0.0,), (0.0,))
    assert not calibration.fidelity.good_enough


ASLANT = [View(Camera(0.3, azimuth, elevation)) for azimuth, elevation in ((60, 0), (70, 10), (10, 65), (-72, 5))]


@pytest.mark.parametrize(
    "truth",
    [
        pytest.param(SamplingModel(anisotropy=2), id="2"),
        pytest.param(SamplingModel(anisotropy=16, elongated="ellipse", filtered="linear"), id="ellipse, linear"),
        pytest.param(SamplingModel(shift=(-0.15, 0.3), lod="area", filtered="linear"), id="-0.15, 0.3, area, linear"),
        pytest.param(SamplingModel(shift=(0.25, 0.0), anisotropy=16), id="both"),
    ],
)
def test_what_few_renderers_do_is_recovered(truth: SamplingModel) -> None:
    texture = np.random.default_rng(0).integers(40, 216, (96, 96, 3), dtype=np.uint8)
    calibration = found(object_of(quad(texture)), KnownTarget(truth), "curve", views=ASLANT)
    sampling = calibration.sampling
    assert (sampling.elongated, sampling.filtered) == (truth.elongated, truth.filtered)
    assert (sampling.anisotropy > 1) == (truth.anisotropy > 1)
    assert sampling.shift == pytest.approx(truth.shift, abs=0.06)
    assert calibration.fidelity.mean()["correlation"] > 0.98


def test_nothing_rare_is_looked_for_where_the_usual_satisfies() -> None:
    tried: list[SamplingModel] = []

    def score(model: SamplingModel) -> float:
        tried.append(model)
        return SATISFYING + 0.01 * (model.samples == "centre")

    assert find_sampling(score) == SamplingModel(samples="centre")
    assert len(tried) == len(set(tried)) < 40
    assert {(model.anisotropy, model.shift) for model in tried} == {(1, (0.0, 0.0))}


def test_something_rare_that_gains_little_is_not_believed() -> None:
    assert find_sampling(lambda model: 0.5 + 0.019 * (model.anisotropy > 1)) == SamplingModel()
    assert find_sampling(lambda model: 0.5 + 0.021 * (model.anisotropy > 1)).anisotropy > 1


def test_a_bias_between_those_that_are_tried_is_read_off_a_parabola() -> None:
    found = find_sampling(lambda model: 0.99 - 0.2 * (model.bias - 0.38) ** 2)
    assert found.bias == pytest.approx(0.38, abs=0.01)
    assert found.but(bias=0.0) == SamplingModel()


def test_where_there_are_no_mip_levels_none_is_looked_for() -> None:
    tried: list[SamplingModel] = []

    def score(model: SamplingModel) -> float:
        tried.append(model)
        return 0.5 + 0.3 * (model.minified == "linear")

    assert find_physics(SamplingModel(), score, (FINEST,)).minified == "linear"
    assert {model.lod for model in tried if model.minified == "linear"} == {"longer"}


@default_sampling()
def test_two_probes_a_view_are_taken_where_they_are_good_enough(mug: Object3D, usual: Usual) -> None:
    asked = Asked(USUAL)
    calibration = found(mug, asked, "auto")
    assert (calibration.model, calibration.greys) == ("calibrated", CALIBRATED_GREYS)
    assert calibration.probes.shape == (2, len(VIEWS), *SIZE, 3)
    assert calibration.fidelity.good_enough
    assert "good enough" in calibration.reason
    assert calibration.renders == asked.images - len(VIEWS)
    assert calibration.renders < usual("curve").renders


def test_no_probe_is_taken_where_the_diffuse_model_is_good_enough(mug: Object3D) -> None:
    asked = Asked(KnownTarget(SamplingModel(), affine=False))
    calibration = found(mug, asked, "auto")
    assert (calibration.model, calibration.greys, len(calibration.probes)) == ("diffuse", (), 0)
    assert "good enough without probes" in calibration.reason
    assert asked.greys == set()
    assert calibration.renders == asked.images - len(VIEWS) < len(VIEWS)


def aces(light: Tensor) -> Tensor:
    """Hill's fit of ACES, as in three.js: it couples the channels."""
    enter = torch.tensor([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
    leave = torch.tensor([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
    toned = (light / 0.6) @ enter.T
    toned = (toned * (toned + 0.0245786) - 0.000090537) / (toned * (0.983729 * toned + 0.4329510) + 0.238081)
    return encode((toned @ leave.T).clamp(0, 1))


def neutral(light: Tensor) -> Tensor:
    """Khronos' PBR Neutral tone mapper: no curve and matrix."""
    low = light.amin(1, keepdim=True)
    light = light - torch.where(low < 0.08, low - 6.25 * low * low, 0.04)
    peak = light.amax(1, keepdim=True)
    pressed = 1 - 0.24**2 / (peak + 0.24 - 0.76)
    grey = 1 / (0.15 * (peak - pressed) + 1)
    return encode(torch.where(peak < 0.76, light, light * pressed / peak * grey + pressed * (1 - grey)).clamp(0, 1))


GRID = SamplingModel(samples="grid", kernel=("gaussian", 4.0), filtered="linear", bias=-0.5)


@pytest.mark.parametrize(
    ("target", "members"),
    [
        pytest.param(KnownTarget(SamplingModel(), film=aces), {"encoding": "measured"}, id="ACES"),
        pytest.param(KnownTarget(SamplingModel(), film=neutral), {}, id="Neutral", marks=pytest.mark.thorough),
        pytest.param(
            KnownTarget(GRID.but(kernel=("blackman-harris", 1.5)), bounce=1.5),
            {"samples": "grid", "kernel": ("blackman-harris", 1.5), "slope": "chord"},
            id="Blackman-Harris, interreflection",
        ),
        pytest.param(
            KnownTarget(SamplingModel(samples="centre", minified="nearest")),
            {"samples": "centre", "minified": "nearest"},
            id="ray caster",
        ),
    ],
)
def test_what_path_tracers_and_films_do_is_recovered(
    mug: Object3D, target: KnownTarget, members: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = Mock(side_effect=measure_tone_map)
    monkeypatch.setattr("trompe_server.surrogate.calibration.measure_tone_map", measured)
    asked = Asked(target)
    calibration = found(mug, asked, "auto")
    assert calibration.model == "calibrated"
    assert measured.call_count <= 1
    assert calibration.renders == asked.images - len(VIEWS)
    assert {name: getattr(calibration.sampling, name) for name in members} == members
    assert (calibration.tone is not None) == (calibration.sampling.encoding == "measured")
    assert calibration.fidelity.mean()["explained"] > 0.9
    assert calibration.fidelity.mean()["slope"] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("size", [(128, 64), (64, 100)])
def test_a_tone_curve_is_the_same_in_upright_and_in_wide_pictures(size: tuple[int, int]) -> None:
    square, found = (
        measure_tone_map(KnownTarget(SamplingModel(), film=aces, size=each), each) for each in (SIZE, size)
    )
    torch.testing.assert_close(found.curves, square.curves, atol=0.01, rtol=0)


def test_pictures_too_small_for_a_tone_curve_are_refused() -> None:
    with pytest.raises(SpecError, match="at least 15 x 15 pixels, and the network's are 64 x 14"):
        measure_tone_map(USUAL, (64, 14))


def test_edges_averaged_in_light_are_predicted_better_as_such() -> None:
    """On bars a few pixels wide, which are mostly edges."""
    texture = np.random.default_rng(0).integers(10, 120, (32, 32, 3), dtype=np.uint8)
    bars = object_of(*(quad(texture, half=0.004, z=0.02 * k) for k in range(-4, 5)))
    truth = SamplingModel(edges="linear", cull=False)
    target, views = KnownTarget(truth), [View(Camera(0.3, azimuth, 5.0)) for azimuth in (60, 75, 105, 120)]
    clean, noise = target(bars, views), painted_noise(bars, np.random.default_rng(0))
    probes = np.stack([target(painted_grey(bars, grey), views) for grey in CALIBRATED_GREYS])

    def explained(sampling: SamplingModel) -> float:
        found = Calibration("calibrated", "", sampling, CALIBRATED_GREYS, probes, Fidelity((), (), (), ()), 0)
        surrogate = build_surrogate(found, bars, views, clean)
        return measure_fidelity(surrogate, bars, clean, noise, target(noise, views)).mean()["explained"]

    assert explained(truth) > explained(truth.but(edges="encoded")) + 0.05


def test_noise_that_all_images_of_a_view_share_disturbs_no_fidelity(mug: Object3D) -> None:
    target = KnownTarget(SamplingModel(), noise=4.0)
    told, untold = (found(mug, target, "calibrated", deterministic=each) for each in (False, True))
    assert 255 * told.noise == pytest.approx(4.0, rel=0.1)
    assert untold.noise == 0.0
    assert told.fidelity.mean()["explained"] > 0.93
    assert told.renders == untold.renders + 4


@pytest.mark.parametrize("wanted", ["diffuse", "calibrated", "curve"])
@default_sampling()
def test_the_model_that_was_asked_for_is_taken_whatever_it_is_worth(mug: Object3D, wanted: SurrogateModel) -> None:
    asked = Asked(KnownTarget(SamplingModel(), affine=wanted == "diffuse"))
    calibration = found(mug, asked, wanted)
    assert calibration.model == wanted
    assert calibration.reason.startswith("requested")
    greys = {"diffuse": (), "calibrated": CALIBRATED_GREYS, "curve": CURVE_GREYS}[wanted]
    assert calibration.greys == greys
    assert set(greys) <= asked.greys
    assert wanted != "diffuse" or asked.greys == set()
    assert calibration.renders == asked.images - len(VIEWS)
    assert calibration.probes.shape == (len(greys), len(VIEWS), *SIZE, 3)


def test_the_probes_are_the_targets_own_images_in_the_order_of_greys_and_views(mug: Object3D, usual: Usual) -> None:
    calibration = usual("curve")
    for grey, probe in zip(calibration.greys, calibration.probes, strict=True):
        assert (probe == USUAL(painted_grey(mug, grey), VIEWS)).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_views_are_enough_and_all_are_tried(mug: Object3D, count: int) -> None:
    asked = Asked(USUAL)
    calibration = found(mug, asked, "curve", views=VIEWS[:count])
    assert calibration.renders == asked.images - count
    assert len(calibration.fidelity.error) == count
    assert calibration.fidelity.good_enough


@pytest.mark.parametrize("wanted", ["diffuse", "auto"])
def test_a_target_that_lies_is_found_out(mug: Object3D, wanted: SurrogateModel) -> None:
    random = np.random.default_rng(0)

    def lying(obj: Object3D, views: Sequence[View]) -> Image8:
        images = USUAL(obj, views).astype(int)
        return np.clip(images + random.normal(0, 20, images.shape), 0, 255).astype(np.uint8)

    calibration = found(mug, lying, wanted)
    assert not calibration.fidelity.good_enough
    assert calibration.fidelity.mean()["explained"] < MIN_EXPLAINED


@pytest.mark.thorough
def test_a_target_that_shows_another_object_is_found_out(mug: Object3D) -> None:
    calibration = found(mug, lambda obj, views: USUAL(obj, views)[:, ::-1].copy(), "auto")
    assert not calibration.fidelity.good_enough


def test_a_surrogate_is_built_again_from_what_was_found(mug: Object3D, usual: Usual) -> None:
    clean = USUAL(mug, VIEWS)
    for wanted in ("diffuse", "calibrated", "curve"):
        surrogate = build_surrogate(usual(wanted), mug, VIEWS, clean)
        assert (surrogate.model, surrogate.n_views) == (wanted, len(VIEWS))
    assert (surrogate.images(mug) == clean).all()


def test_a_real_target_is_understood(mug: Object3D, target: SailenvTarget) -> None:
    asked = Asked(lambda obj, views: target.render(obj, views, size=SIZE))
    calibration = found(mug, asked, "auto")
    mean = calibration.fidelity.mean()
    assert calibration.renders == asked.images - len(VIEWS)
    assert calibration.model in {"calibrated", "curve"}
    assert mean["error"] <= MAX_ERROR
    assert mean["explained"] >= MIN_EXPLAINED
    assert mean["slope"] == pytest.approx(1, abs=0.1)
    assert calibration.fidelity.good_enough


def test_painting_grey_or_noise_keeps_the_object(mug: Object3D) -> None:
    grey, noise = painted_grey(mug, 77), painted_noise(mug, np.random.default_rng(3))
    for painted in (grey, noise):
        assert painted.parts == mug.parts
        assert set(painted.textures) == set(mug.textures)
    assert all((texture == 77).all() for texture in grey.textures.values())
    for name, texture in noise.textures.items():
        change = texture.astype(int) - mug.textures[name]
        free = (mug.textures[name] >= 26) & (mug.textures[name] <= 229)
        assert set(np.unique(change[free])) == {-26, 26}
        assert np.abs(change).max() == 26


@pytest.mark.parametrize(
    "opacity",
    [
        pytest.param(np.indices((24, 40)).sum(axis=0) % 5 * 60, id="with holes"),
        pytest.param(np.where(np.arange(40) < 20, 128, 255) + np.zeros((24, 1)), id="hardly without"),
    ],
)
def test_painting_grey_or_noise_keeps_what_is_cut_out(opacity: NDArray[Any]) -> None:
    alpha = opacity.astype(np.uint8)
    obj = object_of(quad(np.full((24, 40, 3), 100, np.uint8)))
    obj = with_alpha(obj, "m0.png", alpha)
    for painted in (painted_grey(obj, 77), painted_noise(obj, np.random.default_rng(3))):
        kept = decode_alpha(painted.files["m0.png"], "m0.png")
        assert kept is not None
        assert np.array_equal(kept, alpha)


def test_a_photograph_behind_the_object_is_behind_every_surrogate(mug: Object3D) -> None:
    photo = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    outside = (USUAL(painted_grey(mug, 0), VIEWS) == 255).all(axis=-1, keepdims=True)

    clean = np.where(outside, photo, USUAL(mug, VIEWS))
    pictured = [replace(view, background=(0, 0, 0), backdrop="photo") for view in VIEWS]
    calibration = calibrate(mug, VIEWS, clean, USUAL, wanted="diffuse", generator=np.random.default_rng(0))
    images = build_surrogate(calibration, mug, pictured, clean, backdrops={"photo": photo}).images(mug)
    corner = np.s_[:, :4, :4]
    assert outside[corner].all()
    assert (images[corner] == photo[:4, :4]).all()


def test_the_error_of_each_view_is_told(mug: Object3D, usual: Usual) -> None:
    clean = USUAL(mug, VIEWS)
    calibration = usual("calibrated")
    honest = build_surrogate(calibration, mug, VIEWS, clean).clean_errors()
    assert len(honest) == len(VIEWS)
    assert max(honest) < 2 / 255
    lied = clean.copy()
    lied[1] = 255 - lied[1]
    errors = build_surrogate(calibration, mug, VIEWS, lied).clean_errors()
    assert errors[1] > 20 / 255
    assert errors[:1] + errors[2:] == pytest.approx(honest[:1] + honest[2:])


def test_a_surrogate_that_asked_nothing_knows_no_error(mug: Object3D) -> None:
    assert surrogate_of(mug, VIEWS, size=SIZE).clean_errors() == (0.0,) * len(VIEWS)


# Files


SAMPLING = SamplingModel(filtered="linear", bias=-0.25, anisotropy=16, elongated="ellipse", shift=(0.25, -0.125))
PROBES = np.random.default_rng(0).integers(0, 256, (2, 1, 4, 4, 3), dtype=np.uint8)
FOUND = Calibration("calibrated", "asked for", SAMPLING, (0, 128), PROBES, Fidelity((0.1,), (0.9,), (1.0,), (0.8,)), 7)
TONE = ToneMap(torch.rand(3, 1025), torch.rand(9, 9, 9, 3), torch.tensor(0.02))


def test_a_calibration_is_read_as_it_was_written() -> None:
    read, toned = (unpack_calibration(pack_calibration(each)) for each in (FOUND, replace(FOUND, tone=TONE, noise=0.5)))
    assert (read.probes == PROBES).all()
    assert {**vars(read), "probes": None} == {**vars(FOUND), "probes": None}
    assert hash(read.sampling) == hash(SAMPLING)
    assert toned.noise == 0.5
    assert toned.tone is not None
    assert all((array == TONE.arrays()[name]).all() for name, array in toned.tone.arrays().items())


def test_bytes_that_are_no_calibration_are_refused() -> None:
    with pytest.raises(ValueError, match="not a calibration"):
        unpack_calibration(pack_arrays({"probes": PROBES}))
