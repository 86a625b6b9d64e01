"""The colour models: sRGB and its slopes, the curve through the probes, the paper's diffuse formula, tone curves."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from trompe_server.surrogate.pixel_filter import KernelName, PixelFilter, kernel_of
from trompe_server.surrogate.shading import (
    DIM,
    ENCODERS,
    GAIN,
    GAMMA,
    CurveShading,
    DiffuseShading,
    Encoder,
    Encoding,
    decode,
    decode_with_slope,
    encode,
    fit_curve,
    lambert,
)
from trompe_server.surrogate.tone import ToneMap, ToneShading

GREYS = (0, 64, 128, 191, 255)
STEP = 1e-6


def curve(
    greys: tuple[int, ...],
    probes: np.ndarray,
    *,
    coverage: float = 1.0,
    background: float = 0.0,
    encoding: Encoding = "srgb",
) -> CurveShading:
    """The colour model through ``probes``, (greys, pixels, 3) in 0..255."""
    pixels = probes.shape[1]
    return fit_curve(
        torch.tensor(greys, dtype=torch.uint8),
        torch.from_numpy(probes.astype(np.uint8)),
        torch.full((pixels, 1), coverage),
        torch.full((pixels, 3), background),
        encoding,
    )


def random_probes(count: int, *, pixels: int = 40) -> np.ndarray:
    """Probes (count, pixels, 3) that grow with the grey, as those of a renderer do, and stay below white."""
    return np.sort(np.random.default_rng(0).integers(0, 250, (count, pixels, 3)), axis=0)


def values_of(grey: float, *, pixels: int = 40) -> Tensor:
    return torch.full((pixels, 3), grey / 255)


def slope_of(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    return (function(at + STEP) - function(at - STEP)) / (2 * STEP)


UNIT = torch.linspace(0.001, 0.999, 1000, dtype=torch.float64)


def test_srgb_follows_the_standard() -> None:
    encoded = torch.tensor([0, 10, 128, 255], dtype=torch.float64) / 255
    linear = torch.tensor([0, 0.003035269835488375, 0.21586050011389926, 1], dtype=torch.float64)
    torch.testing.assert_close(decode(encoded), linear, atol=1e-8, rtol=1e-6)


def test_decoding_and_encoding_are_inverse_and_grow() -> None:
    torch.testing.assert_close(encode(decode(UNIT)), UNIT, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(decode(encode(UNIT)), UNIT, atol=1e-6, rtol=1e-5)
    assert (decode(UNIT).diff() > 0).all()
    assert (encode(UNIT).diff() > 0).all()


def test_slopes_of_srgb_are_those_of_finite_differences() -> None:
    away = UNIT[(UNIT - 0.04045).abs() > 1e-4]
    knee = torch.where(away < 0.04045, 0.02, 1e-4)
    rising = decode_with_slope(away)[1] * (GAMMA / GAIN)
    assert ((rising / slope_of(decode, away) - 1).abs() <= knee).all()
    light = decode(away)
    assert ((encode.with_slope(light)[1] / slope_of(encode, light) - 1).abs() <= knee).all()


def test_the_power_encoding_is_the_root_and_its_slope_grows_no_further_in_the_dark() -> None:
    encoder = ENCODERS["power"]
    torch.testing.assert_close(encoder(UNIT), UNIT ** (1 / 2.2))
    torch.testing.assert_close(encoder.with_slope(UNIT)[1], slope_of(encoder, UNIT), rtol=1e-4, atol=0)
    dark = torch.tensor([0.0, DIM / 10, DIM], dtype=torch.float64)
    torch.testing.assert_close(encoder(dark), dark ** (1 / 2.2), atol=1e-5, rtol=1e-6)
    slopes = encoder.with_slope(dark)[1]
    torch.testing.assert_close(slopes, slopes[2].expand(3))


@pytest.mark.parametrize("encoder", ENCODERS.values(), ids=ENCODERS)
def test_black_and_white_have_finite_slopes(encoder: Encoder) -> None:
    ends = torch.tensor([0.0, 1.0])
    for slope in (decode_with_slope(ends)[1], encoder.with_slope(ends)[1]):
        assert torch.isfinite(slope).all()
        assert (slope > 0).all()
    assert 0 <= decode(ends)[0] < 1e-8
    for part in (part for value in ends for part in curve(GREYS, random_probes(5))(value.expand(40, 3))):
        assert torch.isfinite(part).all()


@pytest.mark.parametrize("greys", [(0, 128), GREYS], ids=repr)
def test_a_black_pixel_that_an_albedo_would_lighten_has_a_slope(greys: tuple[int, ...]) -> None:
    probes = np.linspace(0, 200, len(greys))[:, None, None] * np.ones((1, 40, 3))
    colour, slope = curve(greys, probes)(values_of(0))
    assert colour.max() < 1e-5
    assert (slope > 0).all()


def test_a_segment_that_bends_into_white_stays_white_behind_it() -> None:
    probes = np.array([0, 120, 200, 255, 255])[:, None, None] * np.ones((1, 1, 3))
    shading = curve(GREYS, probes)
    colours, slopes = zip(*(shading(values_of(grey, pixels=1)) for grey in (160, 191, 220, 255)), strict=True)
    assert [round(float(colour[0, 0]) * 255) for colour in colours[1:]] == [255] * 3
    assert colours[0][0, 0] < 1 < 2 * colours[0][0, 0]
    assert [bool(slope[0, 0] > 0) for slope in slopes] == [True, False, False, False]


@pytest.mark.parametrize("greys", [(0, 255), (0, 100, 255), GREYS], ids=repr)
@pytest.mark.parametrize("coverage", [1.0, 0.5])
def test_a_curve_passes_through_its_probes(greys: tuple[int, ...], coverage: float) -> None:
    probes = np.round(random_probes(len(greys)) * coverage + (1 - coverage) * 255)
    shading = curve(greys, probes, coverage=coverage, background=1.0)
    for grey, probe in zip(greys, probes, strict=True):
        torch.testing.assert_close(shading(values_of(grey))[0] * 255, torch.from_numpy(probe).float(), atol=0.6, rtol=0)


def test_black_and_grey_tell_what_white_shows_and_where_the_image_saturates() -> None:
    bright = np.round(encode(torch.tensor([0.05, 0.15, 0.9])).numpy() * 255)
    shading = curve((0, 128), np.stack([np.zeros((1, 3)), bright[None]]))
    white, slope = shading(torch.ones(1, 3))
    albedo = float(decode(torch.tensor(128 / 255)))
    expected = encode((decode(torch.tensor(bright, dtype=torch.float32) / 255) / albedo).clamp(max=1))
    torch.testing.assert_close(white[0], expected, atol=2e-3, rtol=0)
    assert (slope[0] > 0).tolist() == [True, True, False]


def test_two_probes_are_joined_by_a_line_in_linear_light() -> None:
    black, white = [10, 0, 0], [200, 250, 0]
    shading = curve((0, 255), np.array([[black], [white]]))
    low, high = (decode(torch.tensor(probe) / 255) for probe in (black, white))
    for grey in (30, 128, 220):
        expected = encode(low + decode(torch.tensor(grey / 255)) * (high - low))
        torch.testing.assert_close(shading(values_of(grey, pixels=1))[0][0], expected, atol=2e-3, rtol=0)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=20), st.integers(0, 2**31))
@settings(max_examples=50)
def test_monotone_probes_give_monotone_colours_between_the_first_and_the_last(values: list[float], seed: int) -> None:
    probes = np.sort(np.random.default_rng(seed).integers(0, 250, (5, 1, 3)), axis=0)
    shading = curve(GREYS, probes)
    colours = torch.stack([shading(torch.full((1, 3), value))[0] for value in sorted(values)])
    assert (colours.diff(dim=0) >= -0.3 / 255).all()
    assert (colours * 255 >= torch.from_numpy(probes[0]) - 0.3).all()
    assert (colours * 255 <= torch.from_numpy(probes[-1]) + 0.3).all()


@pytest.mark.parametrize("greys", [(0, 128), GREYS], ids=repr)
@pytest.mark.parametrize("encoding", ["srgb", "power"])
@pytest.mark.parametrize("grey", [12, 50, 90, 160, 230])
def test_slopes_of_a_curve_are_its_finite_differences(grey: int, encoding: Encoding, greys: tuple[int, ...]) -> None:
    probes = 20 + random_probes(len(greys)) * (0.4 if len(greys) == 2 else 0.9)
    shading, step = curve(greys, probes, coverage=0.9, background=0.02, encoding=encoding), 2e-3
    value = values_of(grey)
    slope = shading(value)[1]
    difference = (shading(value + step)[0] - shading(value - step)[0]) / (2 * step)
    torch.testing.assert_close(slope, difference, rtol=0.03, atol=2e-3)


def test_a_pixel_that_no_grey_changes_has_no_slope() -> None:
    for constant in (0, 77, 255):
        colour, slope = curve(GREYS, np.full((5, 2, 3), constant))(values_of(100, pixels=2))
        torch.testing.assert_close(colour * 255, torch.full((2, 3), float(constant)), atol=0.3, rtol=0)
        assert (slope == 0).all()


def test_the_diffuse_model_is_texture_times_shade_over_the_background() -> None:
    shade, coverage = torch.tensor([[0.5], [0.8], [0.8]]), torch.tensor([[1.0], [1.0], [0.25]])
    shading = DiffuseShading(shade * coverage, (1 - coverage) * torch.tensor([0.0, 0.5, 1.0]))
    values = torch.tensor([[0.2, 0.4, 0.6], [1.0, 0.5, 0.0], [1.0, 0.5, 0.0]])
    colour, slope = shading(values)
    expected = [[0.1, 0.2, 0.3], [0.8, 0.4, 0.0], [0.2, 0.1 + 0.375, 0.75]]
    torch.testing.assert_close(colour, torch.tensor(expected))
    torch.testing.assert_close(slope, torch.tensor([[0.5] * 3, [0.8] * 3, [0.2] * 3]))


def test_lambert_is_the_papers_light() -> None:
    normals = torch.tensor([[0.0, 0, 2], [1, 0, 0], [0, 0, -1], [0, 3**0.5, 1]])
    shade = lambert(normals, torch.tensor([0.0, 0, 1]))
    torch.testing.assert_close(shade, torch.tensor([[0.8], [0.5], [0.5], [0.65]]))


# The measured tone curve, and filters over pixels

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


KERNELS: list[tuple[KernelName, float]] = [("box", 1.0), ("tent", 2.0), ("gaussian", 4.0), ("blackman-harris", 3.0)]


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
