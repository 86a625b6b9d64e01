"""Fixtures for the tests of the server."""

import numpy as np
import pytest

from tests.attack_runs import VIEWS, surrogate_of
from tests.surfaces import object_of, quad
from trompe_server.surrogate import Surrogate
from trompe_shared.object3d import Object3D


@pytest.fixture(scope="session")
def square() -> Object3D:
    """A square that the views of ``surrogate`` see from the front, and one behind the cameras that none sees."""
    random = np.random.default_rng(0)
    textures = [random.integers(40, 216, (16, 16, 3), dtype=np.uint8) for _ in range(2)]
    return object_of(quad(textures[0]), quad(textures[1], z=9.0))


@pytest.fixture(scope="session")
def surrogate(square: Object3D) -> Surrogate:
    """12 views of ``square``, 32 x 32, in all of which the fake classifier says class 6."""
    return surrogate_of(square, VIEWS)
