"""The canvas: what views read while some texels move is what they read of the whole textures."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from trompe_server.surrogate import (
    Canvas,
    SamplingModel,
    Surrogate,
    diffuse_surrogate,
    prepare_geometry,
    pyramid,
    textures_of,
)
from trompe_server.surrogate import surrogate as surrogate_module
from trompe_server.surrogate.surrogate import Painted
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D

Make = Callable[..., Any]
VIEWS = [View(Camera(0.5, 0, 0)), View(Camera(1.5, 40, 50)), View(Camera(4.0, -30, 10))]
SIZES = [(64, 32), (24, 20), (15, 30), (1, 8), (1, 1), (34, 6)]
MODELS = {
    "encoded": SamplingModel(cull=False),
    "rounded": SamplingModel(cull=False, mips="rounded"),
    "linear": SamplingModel(cull=False, filtered="linear"),
}


@pytest.fixture(params=SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def obj(request: pytest.FixtureRequest, make_object: Make, make_quad: Make) -> Object3D:
    """Two squares, one with a texture of the size in question."""
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (*size, 3), dtype=np.uint8) for size in (request.param, (16, 16))]
    return make_object(make_quad(images[0]), make_quad(images[1], z=-0.1))  # type: ignore[no-any-return]


@pytest.fixture(params=MODELS.values(), ids=list(MODELS))
def surrogate(request: pytest.FixtureRequest, obj: Object3D) -> Surrogate:
    return diffuse_surrogate(prepare_geometry(obj, VIEWS, size=(48, 48), sampling=request.param), VIEWS)


def some_texels(obj: Object3D, share: float) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {name: torch.rand(image.shape[:2], generator=generator) < share for name, image in obj.textures.items()}


def canvas_and_change(surrogate: Surrogate, obj: Object3D, share: float) -> tuple[Canvas, Tensor, dict[str, Tensor]]:
    """A canvas, random values of it, and the textures that have these."""
    textures, names = textures_of(obj), surrogate.geometry.textures
    canvas = surrogate.canvas(textures, some_texels(obj, share))
    old = canvas.join([textures[name] for name in names])
    new = torch.rand(old.shape, generator=torch.Generator().manual_seed(2))
    changed = {name: textures[name] + change for name, change in zip(names, canvas.split(new - old), strict=True)}
    return canvas, canvas.join([changed[name] for name in names]), changed


@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_views_read_of_a_canvas_what_they_read_of_the_whole_textures(
    obj: Object3D, surrogate: Surrogate, share: float
) -> None:
    canvas, values, changed = canvas_and_change(surrogate, obj, share)
    torch.testing.assert_close(canvas.read(values), surrogate.texels(changed), atol=1e-6, rtol=0)


@pytest.mark.parametrize("share", [0.02, 1.0])
def test_the_gradient_of_a_canvas_is_that_of_the_whole_textures(
    obj: Object3D, surrogate: Surrogate, share: float
) -> None:
    canvas, values, changed = canvas_and_change(surrogate, obj, share)
    leaves = {name: texture.requires_grad_() for name, texture in changed.items()}
    whole, some = surrogate.texels(leaves), canvas.read(values.requires_grad_())
    weights = torch.randn(whole.shape, generator=torch.Generator().manual_seed(3))
    expected = torch.autograd.grad(whole, [leaves[name] for name in surrogate.geometry.textures], weights)
    (found,) = torch.autograd.grad(some, values, weights)
    torch.testing.assert_close(found, canvas.join(list(expected)))


def test_a_canvas_holds_the_texels_that_move_and_splits_into_what_it_joins(obj: Object3D, surrogate: Surrogate) -> None:
    names, masks = surrogate.geometry.textures, some_texels(obj, 0.1)
    canvas = surrogate.canvas(textures_of(obj), masks)
    (held, *others) = canvas.split(torch.ones(sum(canvas.counts), dtype=torch.bool))
    for mask, table in zip((masks[name] for name in names), (held, *others), strict=True):
        assert (table | ~mask).all()
    numbers = torch.arange(float(sum(canvas.counts)))
    assert torch.equal(canvas.join(canvas.split(numbers)), numbers)


def test_the_same_canvas_is_not_made_twice_and_another_is_made_for_other_texels(
    obj: Object3D, surrogate: Surrogate
) -> None:
    textures, masks = textures_of(obj), some_texels(obj, 0.1)
    first = surrogate.canvas(textures, masks)
    assert surrogate.canvas(textures, {name: mask.clone() for name, mask in masks.items()}) is first
    assert surrogate.canvas(textures, some_texels(obj, 0.9)) is not first
    assert surrogate.canvas(textures_of(obj), masks) is not first


@pytest.mark.parametrize("band", [2**18, 16])
def test_views_read_of_stored_levels_what_they_read_of_the_textures(
    obj: Object3D, surrogate: Surrogate, band: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pyramid, "BAND_TEXELS", band)
    expected, painted = surrogate.texels(textures_of(obj)), Painted(obj, surrogate.device)
    torch.testing.assert_close(painted.texels(surrogate.geometry), expected, atol=1e-6, rtol=0)
    again = prepare_geometry(obj, VIEWS[:1], size=(48, 48), sampling=surrogate.geometry.sampling)
    torch.testing.assert_close(painted.texels(again), again.values(textures_of(obj)), atol=1e-6, rtol=0)


def test_stored_levels_of_other_hypotheses_are_dropped_beyond_their_bytes(
    obj: Object3D, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(surrogate_module, "KEPT_LEVELS", 0)
    painted = Painted(obj, torch.device("cpu"))
    for sampling in (*MODELS.values(), MODELS["encoded"]):
        geometry = prepare_geometry(obj, VIEWS, size=(48, 48), sampling=sampling)
        torch.testing.assert_close(painted.texels(geometry), geometry.values(textures_of(obj)), atol=1e-6, rtol=0)
        assert len(painted.stored) == 1
