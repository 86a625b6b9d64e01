"""Fixtures for the tests of the attack."""

import pytest

from trompe_server.surrogate import Surrogate


@pytest.fixture(scope="session")
def surrogate(square_surrogate: Surrogate) -> Surrogate:
    return square_surrogate
