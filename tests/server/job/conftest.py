"""Fixtures for the tests of jobs."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.attack_runs import default_sampling
from tests.job_runs import SmallLibrary
from trompe_server.library import Library
from trompe_server.surrogate import SamplingModel
from trompe_server.surrogate.calibration import find_physics, find_sampling


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return SmallLibrary(tmp_path_factory.mktemp("library"))


@pytest.fixture(scope="session")
def photo() -> NDArray[np.uint8]:
    """(90, 60, 3), in large squares of random colours."""
    image = np.random.default_rng(0).integers(0, 256, (90, 60, 3), dtype=np.uint8)
    return np.kron(image[::15, ::15], np.ones((15, 15, 1), np.uint8))


@pytest.fixture(autouse=True)
def quick_reports(request: pytest.FixtureRequest) -> None:
    """Reports without pictures, unless a test uses ``pictures`` or a job of its module."""
    if "pictures" not in request.fixturenames:
        request.getfixturevalue("no_pictures")


@pytest.fixture
def pictures() -> None:
    """Reports with pictures after all."""


@pytest.fixture(scope="module", autouse=True)
def known_sampling() -> Iterator[None]:
    """Calibrations with the default sampling."""
    with default_sampling():
        yield


@pytest.fixture
def searched_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrations that search the sampling after all."""
    monkeypatch.setattr("trompe_server.surrogate.calibration.find_sampling", find_sampling)
    monkeypatch.setattr("trompe_server.surrogate.calibration.find_physics", find_physics)


@pytest.fixture
def measured_tone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrations that measure the target's tone curve."""
    measured = SamplingModel(encoding="measured")
    monkeypatch.setattr("trompe_server.surrogate.calibration.find_physics", lambda *_: measured)
