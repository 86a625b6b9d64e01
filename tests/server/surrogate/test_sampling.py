"""What a pixel reads of a texture: the pyramid, the weights, the way back, and which way is up."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from tests.surfaces import object_of, quad, with_alpha
from trompe_server.surrogate import Geometry, SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_server.surrogate import pyramid as module
from trompe_server.surrogate.pyramid import mip_chains, mip_layout, read_texels
from trompe_server.surrogate.sampling import Gather
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, View
from trompe_shared.object3d import Object3D

Image8 = NDArray[np.uint8]
MODELS = [
    SamplingModel(),
    SamplingModel(samples="centre", lod="area", bias=0.7),
    SamplingModel(shade_at="centroid", filtered="linear", cull=False, bias=-1.0),
    SamplingModel(anisotropy=4, shift=(0.3, -0.4)),
    SamplingModel(anisotropy=16, elongated="ellipse", samples="centre"),
    SamplingModel(minified="linear"),
    SamplingModel(minified="nearest", samples="centre"),
]
VIEWS = [View(Camera(0.157, 30, 25)), View(Camera(0.2, 200, -20))]
SIZE = (64, 64)
DISTANCE = 1.0


def noise(height: int, width: int, *, seed: int = 0) -> Image8:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def reading(obj: Object3D, model: SamplingModel = MODELS[0], views: list[View] = VIEWS) -> tuple[Geometry, Surrogate]:
    geometry = prepare_geometry(obj, views, size=SIZE, sampling=model)
    return geometry, diffuse_surrogate(geometry, views)


def read_values(obj: Object3D, model: SamplingModel = MODELS[0], views: list[View] = VIEWS) -> list[Tensor]:
    """The texture value that each object pixel of each view reads, encoded, (pixels, 3)."""
    geometry, surrogate = reading(obj, model, views)
    texels = surrogate.texels(textures_of(obj))
    (batch,) = geometry.batches
    return list(torch.split(batch.gather.forward(texels), list(batch.counts)))


def front_view(texture: Image8, *, pixels: float, model: SamplingModel = MODELS[0], **options: Any) -> Tensor:
    """What the pixels read of a square, ``pixels`` wide in the image, that faces the camera: (64, 64, 3), NaN around
    it."""
    focal = SIZE[0] / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    obj = object_of(quad(texture, half=pixels / 2 * DISTANCE / focal, **options))
    views = [View(Camera(DISTANCE, 0, 0))]
    geometry, _ = reading(obj, model, views)
    image = torch.full((SIZE[0] * SIZE[1], 3), torch.nan)
    image[geometry.batches[0].pixel] = read_values(obj, model, views)[0]
    return image.view(*SIZE, 3)


@pytest.mark.parametrize("minified", ["linear", "nearest"])
def test_without_mip_levels_a_pixel_reads_the_texel_at_its_centre(minified: str) -> None:
    texture = noise(48, 48)
    seen = front_view(texture, pixels=16, model=SamplingModel(samples="centre", minified=minified))  # type: ignore[arg-type]
    middle = seen[24:40, 24:40] * 255
    np.testing.assert_allclose(middle, texture[1::3, 1::3], atol=1 if minified == "linear" else 1e-3)


def scaled(level: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """``level`` read linearly at the centres of the new texels."""
    for axis, count in enumerate(size):
        side = level.shape[axis]
        at = ((np.arange(count) + 0.5) * side / count - 0.5).clip(0, side - 1)
        first, second = (np.take(level, index.astype(int), axis) for index in (np.floor(at), np.ceil(at)))
        share = np.expand_dims(at % 1, [k for k in range(level.ndim) if k != axis])
        level = first * (1 - share) + second * share
    return level


def every_texel(layout: module.MipLayout) -> list[Tensor]:
    return [torch.arange(height * width) for sizes in layout.sizes for height, width in sizes]


SIDES = st.one_of(st.integers(1, 20), st.sampled_from([24, 32]))


@given(SIDES, SIDES, st.sampled_from([10, 100, 10_000]))
@settings(max_examples=60)
def test_the_pyramid_is_the_texture_halved_again_and_again(height: int, width: int, band: int) -> None:
    layout = mip_layout([(height, width), (2, 3)])
    textures = [noise(height, width) / 255, noise(2, 3, seed=1) / 255]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BAND_TEXELS", band)
        flat = read_texels([torch.from_numpy(t) for t in textures], mip_chains(layout, every_texel(layout))).numpy()
    assert len(flat) == layout.total
    for level, sizes, starts in zip(textures, layout.sizes, layout.starts, strict=True):
        expected = level
        assert sizes[-1] == (1, 1)
        for size, start in zip(sizes, starts, strict=True):
            expected = scaled(expected, size)
            np.testing.assert_allclose(flat[start : start + size[0] * size[1]].reshape(*size, 3), expected, atol=1e-6)


@given(SIDES, SIDES, st.sampled_from([10, 100, 10_000]), st.floats(0, 1))
@settings(max_examples=60)
def test_the_pyramid_passes_gradients_to_all_that_it_averages(height: int, width: int, band: int, share: float) -> None:
    layout, random = mip_layout([(height, width), (3, 2)]), torch.Generator().manual_seed(height)
    levels = [level[torch.randperm(len(level), generator=random)] for level in every_texel(layout)]
    reads = [level[: round(share * len(level))] for level in levels]
    textures = [torch.rand(*sizes[0], 3, generator=random).requires_grad_() for sizes in layout.sizes]
    changes = [torch.rand(texture.shape, generator=random) for texture in textures]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BAND_TEXELS", band)
        chains = mip_chains(layout, reads)
        texels = read_texels(textures, chains)
        weights = torch.rand(texels.shape, generator=random)
        gradients = torch.autograd.grad(texels, textures, weights)
        moved = read_texels(changes, chains)  # the pyramid is linear
    told = sum(float((gradient * change).sum()) for gradient, change in zip(gradients, changes, strict=True))
    assert told == pytest.approx(float((moved * weights).sum()), rel=1e-4, abs=1e-5)


def test_levels_rounded_to_8_bits_are_rounded_after_columns_and_again_after_rows() -> None:
    texture = torch.tensor([[0, 1], [0, 0]])[..., None].expand(2, 2, 3) / 255
    layout = mip_layout([(2, 2)])
    chains = mip_chains(layout, every_texel(layout))
    exact, rounded = (read_texels([texture], chains, rounded=choice)[-1, 0] for choice in (False, True))
    assert float(exact) * 255 == pytest.approx(0.25)
    assert float(rounded) * 255 == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("size", "chain"),
    [
        pytest.param((1, 1), [(1, 1)], id="one texel"),
        pytest.param((1, 5), [(1, 5), (1, 2), (1, 1)], id="one row"),
        pytest.param((6, 3), [(6, 3), (3, 1), (1, 1)], id="no power of two"),
    ],
)
def test_levels_are_halved_and_rounded_down_to_one_texel(size: tuple[int, int], chain: list[tuple[int, int]]) -> None:
    assert list(mip_layout([size]).sizes[0]) == chain


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_weights_sum_to_one_over_distinct_texels_and_go_back_transposed(mug: Object3D, model: SamplingModel) -> None:
    geometry, _ = reading(mug, model)
    (batch,) = geometry.batches
    count, gather, random = sum(len(reads) for reads in geometry.reads), batch.gather, torch.Generator().manual_seed(0)
    assert isinstance(gather, Gather)
    assert min(batch.counts) > 500
    sums = gather.forward(torch.ones(count, 3))
    torch.testing.assert_close(sums, torch.ones(len(batch.pixel), 3), atol=1e-4, rtol=0)
    taps = torch.diff(gather.offsets, append=torch.tensor([len(gather.index)]))
    pairs = torch.arange(len(batch.pixel)).repeat_interleave(taps) * count + gather.index
    assert (pairs.sort().values.diff() > 0).all()
    assert (torch.bincount(gather.index, minlength=count) > 0).all()
    assert count < geometry.layout.total
    x, y = torch.randn(count, 3, generator=random), torch.randn(len(batch.pixel), 3, generator=random)
    there = (gather.forward(x).double() * y).sum()
    torch.testing.assert_close((gather.transpose(y).double() * x).sum(), there, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_a_texture_of_one_colour_is_read_as_that_colour(mug: Object3D, model: SamplingModel) -> None:
    colour = np.array([250, 128, 3], np.uint8)
    plain = mug.with_textures({name: np.full((5, 3, 3), colour) for name in mug.textures})
    _, surrogate = reading(plain, model)
    texels = surrogate.texels(textures_of(plain))
    images, mean = surrogate.render_all(texels), float(texels[0, 1])
    assert torch.isfinite(images).all()
    for values in read_values(plain, model):
        torch.testing.assert_close(values[:, 1], torch.full((len(values),), mean), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("height", "width"), [(4, 4), (1, 4), (4, 1), (1, 1)])
def test_the_centre_of_a_magnified_texel_shows_it_with_the_files_last_row_at_v_zero(height: int, width: int) -> None:
    texture = noise(height, width)
    seen = front_view(texture, pixels=20)
    rows = [22 + (2 * i + 1) * 20 // height // 2 for i in range(height)]
    columns = [22 + (2 * j + 1) * 20 // width // 2 for j in range(width)]
    torch.testing.assert_close(seen[rows][:, columns] * 255, torch.from_numpy(texture).float(), atol=0.1, rtol=0)
    assert torch.isnan(seen[5, 5, 0])


def test_a_magnified_texture_is_interpolated_in_between() -> None:
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[:, 1] = 200
    middle = front_view(texture, pixels=40)[32, 22:42, 0] * 255
    steps = middle.diff()
    torch.testing.assert_close(steps, torch.full_like(steps, 10.0), atol=0.1, rtol=0)


def test_a_minified_texture_is_read_as_its_average() -> None:
    fine = np.indices((256, 256)).sum(axis=0) % 2 * 200
    seen = front_view(np.repeat(fine[..., None], 3, 2).astype(np.uint8), pixels=32)[18:46, 18:46]
    torch.testing.assert_close(seen * 255, torch.full_like(seen, 100.0), atol=1.0, rtol=0)


@pytest.mark.parametrize("shift", [1, -3, 40])
def test_textures_repeat_outside_of_the_unit_square(shift: int) -> None:
    corners, uvs, texture = quad(noise(8, 8), repeat=2.5)
    views = [View(Camera(0.3, 20, 30))]
    here, there = (read_values(object_of((corners, uvs + k, texture)), views=views)[0] for k in (0, shift))
    torch.testing.assert_close(here, there, atol=2e-3, rtol=0)


def test_two_repetitions_look_like_the_texture_twice() -> None:
    texture = noise(8, 8)
    views = [View(Camera(0.3, 20, 30))]
    repeated = read_values(object_of(quad(texture, repeat=2)), views=views)[0]
    twice = read_values(object_of(quad(np.tile(texture, (2, 2, 1)))), views=views)[0]
    torch.testing.assert_close(repeated, twice, atol=2e-3, rtol=0)


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_where_alpha_is_below_one_half_what_lies_behind_is_read(model: SamplingModel) -> None:
    front, back = quad(np.full((64, 64, 3), 50, np.uint8), z=0.02), quad(np.full((8, 8, 3), 150, np.uint8))
    opacity = np.full((64, 64), 255, np.uint8)
    opacity[:, :32] = 0
    obj, views = with_alpha(object_of(front, back), "m0.png", opacity), [View(Camera(0.5, 0, 0))]
    geometry, _ = reading(obj, model, views)
    values = read_values(obj, model, views)[0][:, 0]
    plain = [object_of(quad(np.full((2, 2, 3), k, np.uint8))) for k in (150, 50)]
    left, right = (read_values(each, model, views)[0][0, 0] for each in plain)
    column = geometry.batches[0].pixel % SIZE[1]
    assert torch.allclose(values[column < 30], left, atol=1e-3)
    assert torch.allclose(values[column > 34], right, atol=1e-3)


def test_a_sheet_that_is_all_cut_out_leaves_every_number_as_if_it_were_not_there() -> None:
    back, sheet = quad(noise(16, 16)), quad(noise(8, 8), z=0.02)
    with_it, alone = with_alpha(object_of(back, sheet), "m1.png", np.zeros((8, 8), np.uint8)), object_of(back)
    first, second = (reading(obj)[0].batches[0] for obj in (with_it, alone))
    assert torch.equal(first.pixel, second.pixel)
    one, other = vars(first.gather), vars(second.gather)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_alpha_is_read_at_the_level_that_the_pixel_reads() -> None:
    """Stripes of one texel, five eighths of them opaque: from afar their mean lets the whole sheet be seen."""
    opacity = np.where(np.arange(256) % 8 < 5, 255, 0).astype(np.uint8)[None].repeat(256, 0)
    obj = object_of(quad(noise(256, 256)))
    views = [View(Camera(2.0, 0, 0))]
    whole, striped, faint = (
        len(reading(each, views=views)[0].batches[0].pixel)
        for each in (obj, with_alpha(obj, "m0.png", opacity), with_alpha(obj, "m0.png", 255 - opacity))
    )
    assert striped == whole
    assert faint == 0


INSIDE = slice(8, 56)
"""Rows and columns that a square of 64 pixels fills, without those near its edge."""


@pytest.mark.parametrize("most", [1, 2, 4, 16])
def test_a_footprint_four_times_as_long_as_wide_is_read_no_wider_than_the_anisotropy_makes_it(most: int) -> None:
    stripes = np.broadcast_to(noise(1, 64), (256, 64, 3)).copy()
    model = SamplingModel(anisotropy=most, samples="centre")
    seen = front_view(stripes, pixels=64, model=model)
    wide = 4 // min(most, 4)  # texels that become one at the level of detail
    level = torch.from_numpy(stripes[0] / 255).float().view(64 // wide, wide, 3).mean(1)
    at = (torch.arange(64) + 0.5) / wide - 0.5
    first, part = at.floor().long(), (at - at.floor())[:, None]
    expected = level[first % len(level)] * (1 - part) + level[(first + 1) % len(level)] * part
    assert torch.allclose(seen[32, INSIDE], expected[INSIDE], atol=0.01)


def test_probes_lie_side_by_side_along_the_longer_axis() -> None:
    texture, model = noise(256, 64), SamplingModel(anisotropy=4, samples="centre")
    seen = front_view(texture, pixels=64, model=model)
    averages = torch.from_numpy(texture / 255).float().view(64, 4, 64, 3).mean(1)
    assert torch.allclose(seen[INSIDE, INSIDE], averages[INSIDE, INSIDE], atol=0.01)


def test_a_square_footprint_is_read_by_one_probe() -> None:
    usual, probed = (front_view(noise(128, 128), pixels=50, model=SamplingModel(anisotropy=most)) for most in (1, 16))
    assert torch.equal(usual.isnan(), probed.isnan())
    assert torch.allclose(usual.nan_to_num(), probed.nan_to_num(), atol=1e-3)


def test_an_ellipse_is_a_gaussian_over_the_texels_of_the_footprint_and_one_around_it() -> None:
    texture, (x, y) = noise(256, 64), (30, 40)
    model = SamplingModel(anisotropy=16, elongated="ellipse", samples="centre", bias=0.01)
    seen = front_view(texture, pixels=64, model=model)[y, x]
    rows, columns = np.indices((256, 64))
    squared = ((columns - x) / 2**0.5) ** 2 + ((rows - (4 * y + 1.5)) / 17**0.5) ** 2
    weight = np.exp(-2 * squared) * (squared < 1)
    expected = (weight[..., None] * texture / 255).sum((0, 1)) / weight.sum()
    assert seen.numpy() == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, -1.0), (-1.0, 1.0)])
@pytest.mark.parametrize("samples", ["msaa4", "msaa4-mirrored", "centre"])
def test_a_shift_by_a_pixel_moves_the_picture_by_one(samples: Any, shift: tuple[float, float], mug: Object3D) -> None:
    pictures = []
    for model in (SamplingModel(samples=samples), SamplingModel(samples=samples, shift=shift)):
        geometry, surrogate = reading(mug, model)
        (batch,) = geometry.batches
        picture = torch.zeros(len(VIEWS) * SIZE[0] * SIZE[1], 3)
        picture[batch.pixel] = batch.gather.forward(surrogate.texels(textures_of(mug))) * batch.coverage
        pictures.append(picture.view(len(VIEWS), *SIZE, 3))
    right, down = map(int, shift)
    moved = torch.roll(pictures[0], (-down, -right), (1, 2))
    assert torch.allclose(moved[:, 1:-1, 1:-1], pictures[1][:, 1:-1, 1:-1], atol=2e-3)


def test_what_a_shift_moves_into_the_image_is_seen_at_its_edge() -> None:
    texture = noise(8, 8)
    corners, *painted = quad(texture, half=0.01)
    right = DISTANCE * np.tan(np.radians(FIELD_OF_VIEW / 2)) + 0.0105  # begins right of the image
    obj = object_of((np.asarray(corners) + np.array([right, 0, 0]), *painted))
    views = [View(Camera(DISTANCE, 0, 0))]
    counts = [reading(obj, SamplingModel(shift=(shift, 0.0)), views)[0].batches[0].counts for shift in (0.0, 1.0)]
    assert counts[0] == (0,)
    assert counts[1] > (0,)
