"""What a pixel reads of a texture: the pyramid, the weights, the way back, and which way is up."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from trompe_server.surrogate import Geometry, SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.sampling import mip_layout, mip_levels
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, View
from trompe_shared.object3d import Object3D

Make = Callable[..., Any]
Image8 = NDArray[np.uint8]
MODELS = [
    SamplingModel(),
    SamplingModel(samples="centre", lod="area", bias=0.7),
    SamplingModel(shade_at="centroid", filtered="linear", cull=False, bias=-1.0),
]
VIEWS = [View(Camera(0.157, 30, 25)), View(Camera(0.2, 200, -20))]
SIZE = (64, 64)
DISTANCE = 1.0


def noise(height: int, width: int, *, seed: int = 0) -> Image8:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def reading(obj: Object3D, model: SamplingModel = MODELS[0], views: list[View] = VIEWS) -> tuple[Geometry, Surrogate]:
    geometry = prepare_geometry(obj, views, size=SIZE, sampling=model)
    return geometry, diffuse_surrogate(geometry, views)


def n_read(geometry: Geometry) -> int:
    """How many texels the views read."""
    return sum(len(reads) for reads in geometry.reads)


def read_values(obj: Object3D, model: SamplingModel = MODELS[0], views: list[View] = VIEWS) -> list[Tensor]:
    """The texture value that each object pixel of each view reads, encoded, (pixels, 3)."""
    geometry, surrogate = reading(obj, model, views)
    texels = surrogate.texels(textures_of(obj))
    (batch,) = geometry.batches
    return list(torch.split(batch.gather.forward(texels), list(batch.counts)))


def front_view(texture: Image8, make_object: Make, make_quad: Make, *, pixels: float, **options: Any) -> Tensor:
    """What the pixels read of a square, ``pixels`` wide in the image, that faces the camera: (64, 64, 3), NaN around
    it."""
    focal = SIZE[0] / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    obj = make_object(make_quad(texture, half=pixels / 2 * DISTANCE / focal, **options))
    views = [View(Camera(DISTANCE, 0, 0))]
    geometry, _ = reading(obj, views=views)
    image = torch.full((SIZE[0] * SIZE[1], 3), torch.nan)
    image[geometry.batches[0].pixel] = read_values(obj, views=views)[0]
    return image.view(*SIZE, 3)


def averaged(level: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Each texel is the mean of those of the level before that it overlaps."""
    (height, width), (h, w) = level.shape[:2], size

    def covered(k: int, n: int, whole: int) -> slice:
        return slice(k * whole // n, -(-(k + 1) * whole // n))

    rows = [[level[covered(i, h, height), covered(j, w, width)].mean(axis=(0, 1)) for j in range(w)] for i in range(h)]
    return np.array(rows)


@given(st.integers(1, 20), st.integers(1, 20))
@settings(max_examples=40, deadline=None)
def test_the_pyramid_is_the_texture_averaged_again_and_again(height: int, width: int) -> None:
    layout = mip_layout([(height, width), (2, 3)])
    textures = [noise(height, width) / 255, noise(2, 3, seed=1) / 255]
    flat = torch.cat(mip_levels([torch.from_numpy(t) for t in textures], layout)).numpy()
    assert len(flat) == layout.total
    for level, sizes, starts in zip(textures, layout.sizes, layout.starts, strict=True):
        expected = level
        assert sizes[-1] == (1, 1)
        for size, start in zip(sizes, starts, strict=True):
            expected = averaged(expected, size)
            np.testing.assert_allclose(flat[start : start + size[0] * size[1]].reshape(*size, 3), expected, atol=1e-6)


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
def test_the_weights_of_each_pixel_sum_to_one(mug: Object3D, model: SamplingModel) -> None:
    geometry, _ = reading(mug, model)
    (batch,) = geometry.batches
    assert min(batch.counts) > 500
    sums = batch.gather.forward(torch.ones(n_read(geometry), 3))
    torch.testing.assert_close(sums, torch.ones(len(batch.pixel), 3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_a_pixel_reads_each_texel_once_and_every_texel_is_read(mug: Object3D, model: SamplingModel) -> None:
    geometry, _ = reading(mug, model)
    (batch,) = geometry.batches
    taps = torch.diff(batch.gather.offsets, append=torch.tensor([len(batch.gather.index)]))
    pixel = torch.arange(len(batch.pixel)).repeat_interleave(taps)
    pairs = pixel * n_read(geometry) + batch.gather.index
    assert (pairs.sort().values.diff() > 0).all()
    assert (torch.bincount(batch.gather.index, minlength=n_read(geometry)) > 0).all()
    assert n_read(geometry) < geometry.layout.total


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


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_the_way_back_is_the_transpose_of_the_way_there(mug: Object3D, model: SamplingModel) -> None:
    geometry, _ = reading(mug, model)
    random = torch.Generator().manual_seed(0)
    (batch,) = geometry.batches
    x = torch.randn(n_read(geometry), 3, generator=random)
    y = torch.randn(len(batch.pixel), 3, generator=random)
    back = batch.gather.transpose(y)
    there = (batch.gather.forward(x).double() * y).sum()
    torch.testing.assert_close((back.double() * x).sum(), there, rtol=1e-3, atol=1e-2)


def test_the_last_row_of_the_image_file_is_at_v_zero_and_the_first_column_at_u_zero(
    make_object: Make, make_quad: Make
) -> None:
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[1, 0] = 200
    seen = front_view(texture, make_object, make_quad, pixels=40)
    assert seen[42, 22, 0] == pytest.approx(200 / 255, abs=0.1)
    for row, column in ((22, 22), (22, 42), (42, 42)):
        assert seen[row, column, 0] < 0.1
    assert torch.isnan(seen[5, 5, 0])


@pytest.mark.parametrize(("height", "width"), [(4, 4), (1, 4), (4, 1), (1, 1)])
def test_a_pixel_over_the_centre_of_a_magnified_texel_reads_that_texel(
    height: int, width: int, make_object: Make, make_quad: Make
) -> None:
    texture = noise(height, width)
    seen = front_view(texture, make_object, make_quad, pixels=20)
    rows = [22 + (2 * i + 1) * 20 // height // 2 for i in range(height)]
    columns = [22 + (2 * j + 1) * 20 // width // 2 for j in range(width)]
    torch.testing.assert_close(seen[rows][:, columns] * 255, torch.from_numpy(texture).float(), atol=0.1, rtol=0)


def test_a_magnified_texture_is_interpolated_in_between(make_object: Make, make_quad: Make) -> None:
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[:, 1] = 200
    middle = front_view(texture, make_object, make_quad, pixels=40)[32, 22:42, 0] * 255
    steps = middle.diff()
    torch.testing.assert_close(steps, torch.full_like(steps, 10.0), atol=0.1, rtol=0)


def test_a_minified_texture_is_read_as_its_average(make_object: Make, make_quad: Make) -> None:
    fine = np.indices((256, 256)).sum(axis=0) % 2 * 200
    seen = front_view(np.repeat(fine[..., None], 3, 2).astype(np.uint8), make_object, make_quad, pixels=32)[
        18:46, 18:46
    ]
    torch.testing.assert_close(seen * 255, torch.full_like(seen, 100.0), atol=1.0, rtol=0)


@pytest.mark.parametrize("shift", [1, -3, 40])
def test_textures_repeat_outside_of_the_unit_square(shift: int, make_object: Make, make_quad: Make) -> None:
    corners, uvs, texture = make_quad(noise(8, 8), repeat=2.5)
    views = [View(Camera(0.3, 20, 30))]
    here, there = (read_values(make_object((corners, uvs + k, texture)), views=views)[0] for k in (0, shift))
    torch.testing.assert_close(here, there, atol=2e-3, rtol=0)


def test_two_repetitions_look_like_the_texture_twice(make_object: Make, make_quad: Make) -> None:
    texture = noise(8, 8)
    views = [View(Camera(0.3, 20, 30))]
    repeated = read_values(make_object(make_quad(texture, repeat=2)), views=views)[0]
    twice = read_values(make_object(make_quad(np.tile(texture, (2, 2, 1)))), views=views)[0]
    torch.testing.assert_close(repeated, twice, atol=2e-3, rtol=0)


def test_each_part_reads_its_own_texture(make_object: Make, make_quad: Make) -> None:
    left, right = (make_quad(np.full((4, 4, 3), k, np.uint8), half=0.1) for k in (50, 150))
    obj = make_object((left[0] - [0.11, 0, 0], *left[1:]), (right[0] + [0.11, 0, 0], *right[1:]))
    views = [View(Camera(0.5, 0, 0))]
    geometry, _ = reading(obj, views=views)
    columns = geometry.batches[0].pixel % SIZE[1]
    values = read_values(obj, views=views)[0][:, 0] * 255
    torch.testing.assert_close(values, torch.where(columns < 32, 50.0, 150.0), atol=0.1, rtol=0)
