"""Degenerate scenes: the surrogate and an attack step give finite numbers and do not change a square in the scene."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.fakes import FakeTarget, fake_classifier
from tests.surfaces import object_of, quad
from trompe_server.attack import Budget, Goal, attack, saliency, start
from trompe_server.surrogate import SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.blocks import repeated
from trompe_server.surrogate.calibration import CURVE_GREYS, Calibration, build_surrogate, calibrate, painted_grey
from trompe_server.surrogate.fidelity import Fidelity
from trompe_shared.errors import ObjectError, SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D

SIZE = (32, 32)
SAMPLING = [
    pytest.param(SamplingModel(), id="msaa"),
    pytest.param(SamplingModel(samples="centre", filtered="linear", lod="area", cull=False), id="centre, linear"),
    pytest.param(SamplingModel(shade_at="centroid", bias=2.0), id="centroid, biased", marks=pytest.mark.thorough),
    pytest.param(SamplingModel(anisotropy=16, shift=(0.3, -0.2)), id="probes, shifted", marks=pytest.mark.thorough),
    pytest.param(SamplingModel(anisotropy=16, elongated="ellipse"), id="ellipse"),
]
FRONT = [View(Camera(0.5, azimuth, elevation)) for azimuth, elevation in ((0, 0), (25, 20))]
EMPTY = View(Camera(0.5, 180, 0))
DEFAULT = SamplingModel()
UNIT_UVS = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])


def noise(height: int, width: int) -> NDArray[np.uint8]:
    return np.random.default_rng(height * 100 + width).integers(30, 226, (height, width, 3), dtype=np.uint8)


def triangle(*corners: object, uvs: object = UNIT_UVS, texture: NDArray[np.uint8] | None = None) -> Any:
    """A surface of one triangle, by default above the square and well visible."""
    points = corners or ([-0.2, 0.12, 0], [0.2, 0.12, 0], [0, 0.2, 0])
    return np.array([points], float), np.asarray(uvs, float), noise(8, 8) if texture is None else texture


def diffuse(
    obj: Object3D, views: Sequence[View], model: SamplingModel = DEFAULT, size: tuple[int, int] = SIZE
) -> Surrogate:
    return diffuse_surrogate(prepare_geometry(obj, views, size=size, sampling=model), views)


def surrogates(obj: Object3D, views: Sequence[View], model: SamplingModel) -> list[Surrogate]:
    """A diffuse surrogate, and one measured on the fake target."""
    clean = FakeTarget(2000).render(obj, views, size=SIZE)
    probes = np.stack([FakeTarget(2000).render(painted_grey(obj, grey), views, size=SIZE) for grey in CURVE_GREYS])
    calibration = Calibration("curve", "", model, CURVE_GREYS, probes, Fidelity((), (), (), ()), 0)
    return [diffuse(obj, views, model), build_surrogate(calibration, obj, views, clean)]


def images_of(surrogate: Surrogate, obj: Object3D) -> Tensor:
    with torch.no_grad():
        return surrogate.render_all(surrogate.texels(textures_of(obj)))


def step_from(surrogate: Surrogate, obj: Object3D) -> dict[str, Tensor]:
    """Changes of each texture in one attack step, with cross-entropy, which never counts as won; none if no texel is
    visible."""
    textures, goal, budget = textures_of(obj), Goal(9, loss="cross_entropy"), Budget(0.05, 0.02)
    step = partial(attack, start(textures), textures, surrogate, fake_classifier(), goal=goal, budget=budget, steps=1)
    effects = [weight * surrogate.footprint[name] for name, weight in surrogate.influence().items()]
    if not any((effect >= 4 / 255 / 0.05).any() for effect in effects):
        with pytest.raises(SpecError, match="No texel changes a pixel visibly"):
            step()
        return {}
    return {name: repeated(delta, textures[name].shape) for name, delta in step().deltas.items()}


def check(obj: Object3D, views: Sequence[View], model: SamplingModel) -> None:
    """Images, influence and one step are finite and in range."""
    for surrogate in surrogates(obj, views, model):
        images = images_of(surrogate, obj)
        assert torch.isfinite(images).all()
        assert 0 <= images.min() <= images.max() <= 1
        influence = surrogate.influence()
        pixels = sum(len(batch.pixel) for batch in surrogate.geometry.batches)
        assert all(torch.isfinite(weight).all() for weight in influence.values())
        assert sum(float(weight.sum()) for weight in influence.values()) == pytest.approx(pixels, rel=1e-3, abs=1e-3)
        for name, delta in step_from(surrogate, obj).items():
            assert torch.isfinite(delta).all()
            assert (delta[influence[name] == 0] == 0).all()


AWKWARD = {
    "a point": triangle([0, 0, 0], [0, 0, 0], [0, 0, 0]),
    "a line": triangle([-1, 0, 0], [0, 0, 0], [1, 0, 0]),
    "a needle": triangle([-0.2, 0.16, 0.01], [0.2, 0.16, 0.01], [0.2, 0.16 + 1e-6, 0.01]),
    "a needle seen edge on": triangle([0, 0.15, -9], [1e-5, 0.15, -9], [0, 0.15, 0.2]),
    "smaller than a pixel": triangle([0.15, 0.15, 0], [0.1501, 0.15, 0], [0.15, 0.1501, 0]),
    "uvs in one point": triangle(uvs=[[[0.3, 0.3]] * 3]),
    "uvs on a line": triangle(uvs=[[[0, 0], [0.5, 0.5], [1, 1]]]),
    "uvs far away": triangle(uvs=[[[1e6, -1e6], [1e6, 9e5], [0, 0]]]),
    "huge uvs": triangle(uvs=[[[1e6, 0], [0, 1e6], [0, 0]]]),
    "one texel": triangle(texture=noise(1, 1)),
    "one row of texels": triangle(texture=noise(1, 37)),
    "one column of texels": triangle(texture=noise(37, 1)),
    "a black texture": triangle(texture=np.zeros((4, 4, 3), np.uint8)),
    "a white texture": triangle(texture=np.full((4, 4, 3), 255, np.uint8)),
    "behind every camera": triangle([-9, -9, 5], [9, -9, 5], [0, 9, 5]),
    "through every camera": triangle([-0.3, 0.3, -9], [0.3, 0.3, -9], [0, 0.4, 9]),
    "seen from behind": triangle([-0.2, 0.12, 0], [0, 0.2, 0], [0.2, 0.12, 0]),
    "very far": triangle([-1e5, -1e5, -1e6], [1e5, -1e5, -1e6], [0, 1e5, -1e6]),
}


@pytest.mark.parametrize("model", SAMPLING)
@pytest.mark.parametrize("awkward", AWKWARD.values(), ids=AWKWARD)
def test_awkward_surfaces_harm_neither_themselves_nor_the_square_beside_them(
    awkward: Any, model: SamplingModel
) -> None:
    square = quad(noise(16, 16))
    both, alone = object_of(square, awkward), object_of(square)
    check(both, FRONT, model)
    with_it, without = (diffuse(obj, FRONT, model) for obj in (both, alone))
    rows = np.s_[..., 20:28, 8:24]  # below the middle, where only the square is
    torch.testing.assert_close(images_of(with_it, both)[rows], images_of(without, alone)[rows], atol=1e-5, rtol=0)


@pytest.mark.parametrize("awkward", AWKWARD.values(), ids=AWKWARD)
def test_awkward_surfaces_on_their_own_do_no_harm(awkward: Any) -> None:
    if awkward is AWKWARD["a point"]:
        with pytest.raises(ObjectError, match="no extent"):
            object_of(awkward)
        return
    obj = object_of(awkward)
    surrogate = diffuse(obj, FRONT)
    assert torch.isfinite(images_of(surrogate, obj)).all()
    assert all(torch.isfinite(delta).all() for delta in step_from(surrogate, obj).values())


def test_a_seam_between_uv_islands_reads_no_texel_of_the_other_side() -> None:
    """Two halves of a square have texels far apart: only pixels on the seam may show a mixture."""
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:, :24], texture[:, 40:] = 40, 200
    texture[:, 24:40] = 255
    corners, uvs, _ = quad(texture)
    uvs[0], uvs[1] = [[0.02, 0], [0.3, 0], [0.3, 1]], [[0.7, 0], [0.98, 1], [0.7, 1]]
    obj = object_of((corners, uvs, texture))
    surrogate = diffuse(obj, FRONT[:1], size=(64, 64))
    values = surrogate.geometry.batches[0].gather.forward(surrogate.texels(textures_of(obj)))[:, 0] * 255
    pure = ((values - 40).abs() < 2) | ((values - 200).abs() < 2)
    assert pure.float().mean() > 0.85
    assert values.min() > 38
    assert values.max() < 202


@pytest.mark.parametrize("model", SAMPLING)
def test_cameras_inside_the_object_or_on_its_surface_do_no_harm(mug: Object3D, model: SamplingModel) -> None:
    places = ((0.001, 10, 10), (0.04, 90, 0), (0.01, 0, 0), (0.05, 200, -60), (0.0999, 90, 0))
    check(mug, [View(Camera(*place)) for place in places], model)


@pytest.mark.parametrize("model", SAMPLING)
def test_an_empty_view_shows_its_background_and_changes_neither_other_views_nor_the_attack(
    model: SamplingModel,
) -> None:
    obj, model = object_of(quad(noise(16, 16))), model.but(cull=True)
    mixed = [FRONT[0], EMPTY, FRONT[1]]
    check(obj, mixed, model)
    check(obj, [EMPTY, EMPTY], model)
    for with_empty, without in zip(surrogates(obj, mixed, model), surrogates(obj, FRONT, model), strict=True):
        images = images_of(with_empty, obj)
        assert with_empty.geometry.batches[0].counts[1] == 0
        assert (images[1] == 1).all()
        assert torch.equal(images[[0, 2]], images_of(without, obj))
    steps = [step_from(diffuse(obj, views), obj)["m0.png"] for views in (mixed, FRONT)]
    assert torch.equal(steps[0], steps[1])
    assert (steps[1] != 0).any()


def test_calibration_survives_an_empty_view() -> None:
    obj, views = object_of(quad(noise(16, 16))), [FRONT[0], EMPTY, FRONT[1]]
    target = FakeTarget(2000)
    for wanted in ("diffuse", "curve"):
        clean = target.render(obj, views, size=SIZE)
        ask = partial(target.render, size=SIZE)
        found = calibrate(obj, views, clean, ask, wanted=wanted, generator=np.random.default_rng(0))
        assert all(np.isfinite(value) for value in found.fidelity.mean().values())


def test_a_black_object_on_black_is_black_and_can_be_attacked() -> None:
    obj = object_of(quad(np.zeros((8, 8, 3), np.uint8)))
    views = [View(view.camera, view.light, (0, 0, 0)) for view in FRONT]
    check(obj, views, DEFAULT)
    for surrogate in surrogates(obj, views, DEFAULT):
        assert images_of(surrogate, obj).max() < 0.01
        step = step_from(surrogate, obj)["m0.png"]
        assert (step >= 0).all()
        assert step.max() > 0
    maps = saliency(np.zeros((2, *SIZE, 3), np.uint8), fake_classifier(), goal=Goal(3))
    assert torch.isfinite(maps).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 41), (41, 1)])
def test_images_of_a_single_row_column_or_pixel_are_drawn(size: tuple[int, int]) -> None:
    obj = object_of(quad(noise(16, 16)))
    images = images_of(diffuse(obj, FRONT, SamplingModel(samples="centre"), size), obj)
    assert images.shape == (2, 3, *size)
    assert torch.isfinite(images).all()
    assert (images < 1).any()
