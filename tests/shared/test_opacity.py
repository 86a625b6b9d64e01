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


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP"])
def test_a_picture_without_alpha_cuts_nothing_out(kind: str) -> None:
    assert opacity_of(saved(RED, kind)) is None


@pytest.mark.parametrize("alpha", [128, 255])
def test_alpha_of_one_half_or_more_cuts_nothing_out(alpha: int) -> None:
    picture = RED.copy()
    picture.putalpha(alpha)
    assert opacity_of(saved(picture)) is None


def test_alpha_below_one_half_is_read_texel_by_texel() -> None:
    alpha = np.random.default_rng(0).integers(0, 256, (3, 5), dtype=np.uint8)
    picture = RED.copy()
    picture.putalpha(Image.fromarray(alpha))
    np.testing.assert_array_equal(opacity_of(saved(picture)), alpha)


def test_a_transparent_colour_of_a_palette_is_cut_out() -> None:
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 255, 0])
    picture.putpixel((1, 0), 1)
    picture.info["transparency"] = 1
    found = opacity_of(saved(picture))
    assert found is not None
    assert found.tolist() == [[255, 0]]
