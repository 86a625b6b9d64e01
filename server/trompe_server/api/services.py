"""Services behind the routes, and their dependencies."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from trompe_server.api.downloads import Digests
from trompe_server.library import Library
from trompe_server.queue.store import JobStore
from trompe_server.settings import Settings
from trompe_server.storage.folders import Folder, JobArtifacts, job_artifacts
from trompe_server.storage.tokens import Tokens
from trompe_shared.api import RendererInfo


@dataclass(frozen=True)
class Services:
    """Services behind the API. ``missing`` names the parts that are down; ``renderers`` checks each renderer."""

    settings: Settings
    library: Library
    store: JobStore
    files: Folder
    tokens: Tokens
    renderers: Callable[[], list[RendererInfo]]
    missing: Callable[[], list[str]]

    def artifacts(self, job: str) -> JobArtifacts:
        """The files of a job, for reading."""
        return job_artifacts(self.files, job)


def _services(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


def _library(request: Request) -> Library:
    return _services(request).library


def _store(request: Request) -> JobStore:
    return _services(request).store


def _digests(request: Request) -> Digests:
    digests: Digests = request.app.state.digests
    return digests


ServicesDep = Annotated[Services, Depends(_services)]
LibraryDep = Annotated[Library, Depends(_library)]
StoreDep = Annotated[JobStore, Depends(_store)]
DigestsDep = Annotated[Digests, Depends(_digests)]
