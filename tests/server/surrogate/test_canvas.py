"""The canvas: what views read while some texels move is what they read of the whole textures; blocks move together."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.attack_runs import surrogate_of
from tests.surfaces import object_of, quad
from trompe_server.surrogate import Canvas, SamplingModel, Surrogate, joined, prepare_geometry, pyramid, textures_of
from trompe_server.surrogate import surrogate as surrogate_module
from trompe_server.surrogate.blocks import (
    by_block,
    common_change,
    halvings,
    means,
    most_halvings,
    repeated,
    rooms,
    whole,
)
from trompe_server.surrogate.surrogate import Painted
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D

VIEWS = [View(Camera(0.5, 0, 0)), View(Camera(1.5, 40, 50)), View(Camera(4.0, -30, 10))]
SIZES = [(64, 32), (24, 20), (15, 30), (1, 8), (1, 1), (34, 6)]
MODELS = {
    "encoded": SamplingModel(cull=False),
    "rounded": SamplingModel(cull=False, mips="rounded"),
    "linear": SamplingModel(cull=False, filtered="linear"),
}


@pytest.fixture(scope="module", params=SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def obj(request: pytest.FixtureRequest) -> Object3D:
    """Two squares, one with a texture of the size in question."""
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (*size, 3), dtype=np.uint8) for size in (request.param, (16, 16))]
    return object_of(quad(images[0]), quad(images[1], z=-0.1))


@pytest.fixture(scope="module", params=MODELS.values(), ids=list(MODELS))
def surrogate(request: pytest.FixtureRequest, obj: Object3D) -> Surrogate:
    return surrogate_of(obj, VIEWS, size=(48, 48), sampling=request.param)


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
def test_views_read_of_a_canvas_what_they_read_of_textures(obj: Object3D, surrogate: Surrogate, share: float) -> None:
    canvas, values, changed = canvas_and_change(surrogate, obj, share)
    torch.testing.assert_close(canvas.read(values), surrogate.texels(changed), atol=1e-6, rtol=0)


@pytest.mark.parametrize("share", [0.02, 1.0])
def test_the_gradient_of_a_canvas_is_that_of_whole_textures(obj: Object3D, surrogate: Surrogate, share: float) -> None:
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


def test_a_canvas_is_not_made_twice_and_another_is_made_for_other_texels(obj: Object3D, surrogate: Surrogate) -> None:
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


def test_stored_levels_beyond_their_bytes_are_dropped(obj: Object3D, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surrogate_module, "KEPT_LEVELS", 0)
    painted = Painted(obj, torch.device("cpu"))
    for sampling in (*MODELS.values(), MODELS["encoded"]):
        geometry = prepare_geometry(obj, VIEWS, size=(48, 48), sampling=sampling)
        torch.testing.assert_close(painted.texels(geometry), geometry.values(textures_of(obj)), atol=1e-6, rtol=0)
        assert len(painted.stored) == 1


# Blocks: their means, and how much they may change

COUNTS = st.integers(0, 3)
SEEDS = st.integers(0, 2**31)
AFAR = [View(Camera(3.0, 0, 0)), View(Camera(4.0, 40, 30))]


def textured(seed: int) -> Tensor:
    """8-bit colours, black and white among them."""
    random = np.random.default_rng(seed)
    return torch.from_numpy(random.integers(-80, 336, (16, 24, 3)).clip(0, 255).astype(np.uint8))


def by_hand(table: Tensor, count: int) -> Tensor:
    return by_block(table.float(), count).mean((1, 3))


@given(COUNTS, SEEDS)
def test_means_and_rooms_are_those_of_the_texels_of_each_block(count: int, seed: int) -> None:
    texture = textured(seed) / 255
    bound = torch.rand(16 >> count, 24 >> count, 1, generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(means(texture, count), by_hand(texture, count))
    down, up = rooms(texture, bound, count)
    limit = repeated(bound, texture.shape)
    torch.testing.assert_close(down, by_hand(torch.minimum(texture, limit), count))
    torch.testing.assert_close(up, by_hand(torch.minimum(1 - texture, limit), count))
    assert halvings(down.shape, texture.shape) == count


@given(COUNTS, SEEDS, st.floats(0.004, 1))
@settings(max_examples=60)
def test_a_common_change_has_the_mean_asked_for_and_stays_within_the_bound(count: int, seed: int, bound: float) -> None:
    texture = textured(seed)
    down, up = rooms(texture / 255, torch.full((16 >> count, 24 >> count, 1), bound), count)
    share = torch.rand(down.shape, generator=torch.Generator().manual_seed(seed))
    share = (1.5 * share - 0.25).clamp(0, 1)  # the ends of the range among them
    mean = share * up - (1 - share) * down
    change = common_change(mean, texture)
    assert change.abs().max() <= bound + 1e-4
    painted = (texture / 255 + repeated(change, texture.shape)).clamp(0, 1)
    torch.testing.assert_close(by_hand(painted - texture / 255, count), mean, atol=2e-4, rtol=0)


def test_no_change_of_a_mean_changes_no_texel() -> None:
    assert not common_change(torch.zeros(4, 6, 3), textured(0)).any()


def test_a_block_is_whole_if_all_its_texels_are() -> None:
    mask = torch.zeros(8, 12, dtype=torch.bool)
    mask[2:8, 3:12] = True
    assert whole(mask, 1).nonzero().tolist() == [[row, column] for row in (1, 2, 3) for column in (2, 3, 4, 5)]
    assert whole(mask, 2).nonzero().tolist() == [[1, 1], [1, 2]]
    assert torch.equal(whole(mask, 0), mask)


@pytest.mark.parametrize(
    ("size", "wanted", "most"), [((64, 32), 9, 5), ((24, 20), 9, 2), ((15, 30), 3, 0), ((1, 1), 4, 0), ((64, 64), 2, 2)]
)
def test_blocks_divide_their_texture(size: tuple[int, int], wanted: int, most: int) -> None:
    assert most_halvings(size, wanted) == most


@pytest.fixture
def fine() -> Object3D:
    """A square with a texture much finer than the pixels of ``AFAR``, and one with a coarse texture."""
    image = np.random.default_rng(0).integers(60, 200, (256, 256, 3), dtype=np.uint8)
    return object_of(quad(image), quad(image[:8, :8], z=-0.1))


def of_blocks(obj: Object3D, **sampling: Any) -> Surrogate:
    return surrogate_of(obj, AFAR, sampling=SamplingModel(cull=False, **sampling))


def test_the_mip_levels_that_views_hardly_read_are_spare(fine: Object3D) -> None:
    surrogate, names = of_blocks(fine), sorted(fine.textures)
    weights = [0.0] * 9
    for level, reads in enumerate(surrogate.geometry.reads[:9]):
        first = sum(map(len, surrogate.geometry.reads[:level]))
        weights[level] = float(surrogate.geometry.read_weights()[first : first + len(reads)].sum())
    shares = np.cumsum(weights) / sum(weights)
    spare = surrogate.spare_levels[names[0]]
    assert spare >= 2
    assert shares[spare - 1] < 0.05 <= shares[spare]
    assert joined([surrogate, of_blocks(fine, bias=-2.0)]).spare_levels[names[0]] == spare - 2


@pytest.mark.parametrize(("minified", "samples"), [("linear", "msaa4"), ("nearest", "msaa4"), ("nearest", "grid")])
def test_texels_without_mip_levels_move_with_what_a_pixel_shows(fine: Object3D, minified: str, samples: str) -> None:
    usual = of_blocks(fine, samples="centre" if samples == "grid" else samples)  # not what a sub-pixel shows
    surrogate, names = of_blocks(fine, minified=minified, samples=samples), sorted(fine.textures)
    assert not any(map(len, surrogate.geometry.reads[1:9]))
    assert all(torch.equal(surrogate.influence()[name], weight) for name, weight in usual.influence().items())
    shares = usual.level_weights[names[0]].cumsum(0) / usual.level_weights[names[0]].sum()
    spare = surrogate.spare_levels[names[0]]
    assert spare >= usual.spare_levels[names[0]] > 0
    assert shares[spare - 1] < 0.5 <= shares[spare]


@pytest.mark.parametrize(
    ("sampling", "error"),
    [({}, 1e-6), ({"mips": "rounded"}, 1.01 / 255), ({"filtered": "linear"}, 0.5 / 255)],
    ids=["encoded", "rounded", "linear"],
)
@pytest.mark.parametrize("share", [0.1, 1.0])
def test_views_read_of_moved_blocks_what_they_read_of_their_moved_texels(
    fine: Object3D, sampling: dict[str, str], error: float, share: float
) -> None:
    surrogate, textures = of_blocks(fine, **sampling), textures_of(fine)
    generator = torch.Generator().manual_seed(1)
    moving = {
        name: torch.rand(surrogate.geometry.layout.sizes[k][min(2, 2 * (1 - k))], generator=generator) < share
        for k, name in enumerate(surrogate.geometry.textures)
    }
    canvas = surrogate.canvas(textures, moving)
    torch.testing.assert_close(canvas.read(canvas.source), surrogate.texels(textures), atol=1e-6, rtol=0)
    change = 0.2 * torch.rand(canvas.source.shape, generator=generator) - 0.1
    tables = dict(zip(surrogate.geometry.textures, canvas.split(change), strict=True))
    painted = {name: texture + repeated(tables[name], texture.shape) for name, texture in textures.items()}
    torch.testing.assert_close(canvas.read(canvas.source + change), surrogate.texels(painted), atol=error, rtol=0)


@pytest.mark.parametrize("bound", [0.02, 0.05, 0.1])
def test_the_light_of_blocks_is_that_of_their_texels_as_far_as_these_have_room(fine: Object3D, bound: float) -> None:
    random = np.random.default_rng(1)
    images = [random.integers(-200, 456, (256, 256, 3)).clip(0, 255).astype(np.uint8) for _ in range(2)]
    images[0][:64], images[0][64:128] = 0, 255
    obj = fine.with_textures(dict(zip(sorted(fine.textures), images, strict=True)))
    surrogate, textures = of_blocks(obj, filtered="linear"), textures_of(obj)
    canvas = surrogate.canvas(textures, {name: torch.ones(64, 64, dtype=torch.bool) for name in textures})
    generator, changes, painted = torch.Generator().manual_seed(2), {}, {}
    for name, texture in textures.items():
        down, up = rooms(texture, torch.full((64, 64, 1), bound), 2)
        changes[name] = torch.where(torch.rand(down.shape, generator=generator) < 0.5, -down, up)
        common = common_change(changes[name], torch.from_numpy(obj.textures[name]))
        painted[name] = (texture + repeated(common, texture.shape)).clamp(0, 1)
    values = canvas.source + canvas.join([changes[name] for name in surrogate.geometry.textures])
    seen, true = canvas.read(values), surrogate.texels(painted)
    assert (true - surrogate.texels(textures)).abs().max() > 0.3 * bound
    torch.testing.assert_close(seen, true, atol=0.002, rtol=0)
