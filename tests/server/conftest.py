"""Fixtures for the tests of the server."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.attack_runs import VIEWS, surrogate_of
from trompe_server.surrogate import Surrogate
from trompe_shared.object3d import Object3D, pack_zip

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl paint\nf 1/1 2/2 3/3\n"


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def square(make_object: Callable[..., Object3D], make_quad: Callable[..., Any]) -> Object3D:
    """A square that the views of ``surrogate`` see from the front, and one behind the cameras that none sees."""
    random = np.random.default_rng(0)
    textures = [random.integers(40, 216, (16, 16, 3), dtype=np.uint8) for _ in range(2)]
    return make_object(make_quad(textures[0]), make_quad(textures[1], z=9.0))


@pytest.fixture(scope="session")
def surrogate(square: Object3D) -> Surrogate:
    """12 views of ``square``, 32 x 32, in all of which the fake classifier says class 6."""
    return surrogate_of(square, VIEWS)
