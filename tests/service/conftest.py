"""What the tests of the service share: databases of both kinds, and worker processes that run fake pipelines."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from postgres import Postgres, find_programs
from processes import Service, listening

from trompe_server.jobs.store import JobStore
from trompe_server.settings import Settings


@pytest.fixture(scope="session")
def shared_postgres() -> Iterator[Any]:
    """A PostgreSQL that all tests share, each in a database of its own."""
    yield from _running()


@pytest.fixture
def postgres() -> Iterator[Any]:
    """A PostgreSQL that a test has for itself, to stop it."""
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
    """The URL of an empty database; a test that asks for it runs once on each kind."""
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


@pytest.fixture
def renderer() -> Iterator[int]:
    """The port of something that plays a renderer for fake pipelines."""
    with listening() as port:
        yield port


@pytest.fixture
def service(database_url: str, tmp_path: Path, renderer: int) -> Iterator[Any]:
    """A service whose workers count as dead after two seconds of silence; on each kind of database."""
    service = Service(Settings(data=tmp_path, database=database_url, silence=2.0), renderer)
    yield service
    service.close()
