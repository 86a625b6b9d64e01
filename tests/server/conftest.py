"""Fixtures for the tests of the server."""

import io
from collections.abc import Callable

import pytest
from PIL import Image

from trompe_shared.object3d import pack_zip

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl paint\nf 1/1 2/2 3/3\n"


@pytest.fixture
def triangle_zip() -> Callable[..., bytes]:
    """Makes the archive of a valid object, one textured triangle of a colour."""
    return _triangle_zip


def _triangle_zip(*, colour: tuple[int, int, int] = (200, 30, 30)) -> bytes:
    picture = io.BytesIO()
    Image.new("RGB", (8, 8), colour).save(picture, "PNG")
    materials = b'{"paint": {"albedo": "paint.png"}}'
    return pack_zip(
        {"triangle.obj": TRIANGLE.encode(), "triangle_mat_def.json": materials, "paint.png": picture.getvalue()}
    )
