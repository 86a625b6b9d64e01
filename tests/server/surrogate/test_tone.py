"""The measured tone curve: its derivatives, its inverse, and what it predicts."""

import pytest
import torch
from torch import Tensor

from trompe_server.surrogate.pixel_filter import KernelName, PixelFilter, kernel_of
from trompe_server.surrogate.tone import ToneMap, ToneShading

LIGHT = torch.rand(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1.6 + 0.05


@pytest.fixture(scope="module")
def tone() -> ToneMap:
    """A curve with coupled channels: the square root, and red loses what is blue."""
    place = torch.linspace(0, 1, 1025, dtype=torch.float64)
    curves = (place + 0.1 * (3 * place).sin()).expand(3, -1) * 0.8
    levels = torch.linspace(0, 1, 9, dtype=torch.float64)
    red, green, blue = torch.meshgrid(levels, levels, levels, indexing="ij")
    residuals = torch.stack([-0.15 * blue * red, 0.05 * red, 0.1 * green * green], -1)
    return ToneMap(curves, residuals, torch.tensor(0.03, dtype=torch.float64))


def test_the_slopes_of_a_tone_curve_are_those_of_finite_differences(tone: ToneMap) -> None:
    _, slopes = tone.with_slope(LIGHT)
    for channel, way in enumerate(1e-6 * torch.eye(3, dtype=torch.float64)):
        seen = (tone.with_slope(LIGHT + way)[0] - tone.with_slope(LIGHT - way)[0]) / 2e-6
        away = (seen - slopes[..., channel]).abs().amax(1)
        assert (away > 0.01).double().mean() < 0.02  # the nodes themselves, where the slope jumps
        assert away.median() < 1e-4


def test_light_is_read_back_from_what_it_shows(tone: ToneMap) -> None:
    torch.testing.assert_close(tone.light_of(tone.with_slope(LIGHT)[0]), LIGHT, atol=1e-4, rtol=0)


def test_the_slopes_of_the_colour_model_are_those_of_finite_differences(tone: ToneMap) -> None:
    random = torch.Generator().manual_seed(1)
    light, slope, shift = (0.3 * torch.rand(400, 3, generator=random, dtype=torch.float64) for _ in range(3))
    coverage = torch.rand(400, 1, generator=random, dtype=torch.float64)
    shading = ToneShading(tone, light, slope + 0.3, coverage, shift / 3)
    values = torch.rand(400, 3, generator=random, dtype=torch.float64) * 0.8 + 0.1
    _, slopes = shading(values)
    for channel, way in enumerate(1e-6 * torch.eye(3, dtype=torch.float64)):
        seen = (shading(values + way)[0] - shading(values - way)[0]) / 2e-6
        assert ((seen - slopes[..., channel]).abs().amax(1) > 0.01).double().mean() < 0.03


KERNELS: tuple[tuple[KernelName, float], ...] = (
    ("box", 1.0),
    ("tent", 2.0),
    ("gaussian", 4.0),
    ("blackman-harris", 3.0),
)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_filter_averages_and_its_transpose_is_its_transpose(kernel: tuple[KernelName, float]) -> None:
    weights, random = kernel_of(*kernel, 4), torch.Generator().manual_seed(0)
    assert float(weights.sum()) == pytest.approx(1)
    assert torch.equal(weights, weights.flip(0))
    everywhere = torch.arange(2 * 32 * 32)
    _, coverage = PixelFilter.of(everywhere, torch.ones(len(everywhere), 1), (2, 8, 8), weights, 4)
    inside = coverage.view(2, 8, 8)[:, 2:6, 2:6]
    torch.testing.assert_close(inside, torch.ones_like(inside))
    some = everywhere[torch.rand(len(everywhere), generator=random) < 0.3]
    part, shown = PixelFilter.of(some, torch.ones(len(some), 1), (2, 8, 8), weights, 4)
    values, pixels = (torch.randn(n, 3, generator=random) for n in (len(some), len(part.pixel)))
    there, back = (part.forward(values) * pixels).sum(), (values * part.transpose(pixels)).sum()
    torch.testing.assert_close(there, back)
    assert shown.min() >= 0.02


def test_a_box_filter_is_the_mean_of_a_pixels_own_sub_pixels() -> None:
    picture: Tensor = torch.randn(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    whole, _ = PixelFilter.of(torch.arange(256), torch.ones(256, 1), (1, 4, 4), kernel_of("box", 1.0, 4), 4)
    mean = torch.nn.functional.avg_pool2d(picture, 4)[0].flatten(1).T
    torch.testing.assert_close(whole.forward(picture[0].flatten(1).T), mean)
