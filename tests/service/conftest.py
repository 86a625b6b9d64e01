"""Databases of both kinds, and worker processes with fake jobs."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.postgres import Postgres, find_programs
from tests.service.processes import Service, listening
from tests.service.ray_nodes import ACCESS, RayNodes
from trompe_server.queue.store import JobStore
from trompe_server.settings import Settings


@pytest.fixture(scope="session")
def shared_postgres() -> Iterator[Any]:
    """A PostgreSQL shared by all tests, each in its own database."""
    yield from _running()


@pytest.fixture
def postgres() -> Iterator[Any]:
    """A PostgreSQL for one test, which may stop it."""
    yield from _running()


def _running() -> Iterator[Any]:
    programs = find_programs()
    if programs is None:
        pytest.skip("NOT TESTED ON POSTGRESQL: there is no initdb here; install it: sudo apt-get install postgresql")
    server = Postgres(programs)
    try:
        server.start()
        yield server
    finally:
        server.close()


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of an empty database; a test runs once on each kind."""
    return _empty_database(request, tmp_path)


def _empty_database(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'trompe.sqlite'}"
    url: str = request.getfixturevalue("shared_postgres").database()
    return url


@pytest.fixture
def store(database_url: str) -> Iterator[JobStore]:
    """An empty record of jobs."""
    store = JobStore(database_url)
    store.migrate()
    yield store
    store.close()


@pytest.fixture(scope="session")
def ray_access() -> Iterator[None]:
    """The environment in which this process reaches Ray clusters: Ray reads it once, when it is imported."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in ACCESS.items():
            patch.setenv(name, value)
        pytest.importorskip("ray", reason="Ray is not installed: pip install 'trompe[cluster]'")
        yield


@pytest.fixture(scope="module")
def cluster(ray_access: None) -> Iterator[RayNodes]:
    """A Ray cluster of three nodes."""
    with RayNodes() as nodes:
        yield nodes


@pytest.fixture
def renderer() -> Iterator[int]:
    """The port of a listener that passes for a renderer."""
    with listening() as port:
        yield port


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.thorough)])
def service(request: pytest.FixtureRequest, tmp_path: Path, renderer: int) -> Iterator[Any]:
    """A service on each kind of database. Workers count as dead after ten seconds without a heartbeat, longer than a
    busy machine holds up a worker that lives."""
    database = _empty_database(request, tmp_path)
    service = Service(Settings(data=tmp_path, database=database, silence=10.0), renderer)
    yield service
    service.store.close()
