"""What the routes work with, and how they get it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from trompe_server.artifacts import LocalArtifacts
from trompe_server.jobs.engine import JobQueue
from trompe_server.jobs.store import JobStore
from trompe_server.library import Library
from trompe_server.settings import Settings

__all__ = ["LibraryDep", "Services", "ServicesDep", "StoreDep"]


@dataclass(frozen=True)
class Services:
    """Everything behind the API. ``missing`` says what is not up right now, in words."""

    settings: Settings
    library: Library
    store: JobStore
    queue: JobQueue
    missing: Callable[[], list[str]]

    def artifacts(self, job: str) -> LocalArtifacts:
        """The files of a job."""
        return LocalArtifacts(self.settings.artifacts(job))


def _services(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


def _library(request: Request) -> Library:
    return _services(request).library


def _store(request: Request) -> JobStore:
    return _services(request).store


ServicesDep = Annotated[Services, Depends(_services)]
LibraryDep = Annotated[Library, Depends(_library)]
StoreDep = Annotated[JobStore, Depends(_store)]
