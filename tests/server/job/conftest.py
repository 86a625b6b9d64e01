"""Fixtures for the tests of jobs."""

import numpy as np
import pytest
from numpy.typing import NDArray

from trompe_server.library import Library


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library(tmp_path_factory.mktemp("library"))


@pytest.fixture(scope="session")
def photo() -> NDArray[np.uint8]:
    """(90, 60, 3), in large squares of random colours."""
    image = np.random.default_rng(0).integers(0, 256, (90, 60, 3), dtype=np.uint8)
    return np.kron(image[::15, ::15], np.ones((15, 15, 1), np.uint8))


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without pictures, which take as long as a small attack."""
    monkeypatch.setattr("trompe_server.job.report.picture_files", lambda _: {})
