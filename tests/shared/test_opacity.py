"""What an albedo's alpha channel cuts out."""

import io

import numpy as np
import pytest
from PIL import Image

from trompe_shared.opacity import opacity_of


def saved(picture: Image.Image, kind: str = "PNG") -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind)
    return buffer.getvalue()


RED = Image.new("RGB", (5, 3), (200, 0, 0))


def with_alpha(alpha: int | Image.Image) -> Image.Image:
    picture = RED.copy()
    picture.putalpha(alpha)
    return picture


@pytest.mark.parametrize(
    "data",
    [*(saved(RED, kind) for kind in ("PNG", "JPEG", "BMP")), *(saved(with_alpha(alpha)) for alpha in (128, 255))],
    ids=["PNG", "JPEG", "BMP", "one half", "opaque"],
)
def test_no_alpha_and_alpha_of_one_half_or_more_cut_nothing_out(data: bytes) -> None:
    assert opacity_of(data) is None


def test_alpha_below_one_half_is_read_texel_by_texel() -> None:
    alpha = np.random.default_rng(0).integers(0, 256, (3, 5), dtype=np.uint8)
    np.testing.assert_array_equal(opacity_of(saved(with_alpha(Image.fromarray(alpha)))), alpha)


def test_a_transparent_colour_of_a_palette_is_cut_out() -> None:
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 255, 0])
    picture.putpixel((1, 0), 1)
    picture.info["transparency"] = 1
    found = opacity_of(saved(picture))
    assert found is not None
    assert found.tolist() == [[255, 0]]
