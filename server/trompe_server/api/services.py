"""Services behind the routes, and their dependencies."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Final

from fastapi import Depends, Request

from trompe_server.api.middleware import HttpMetrics
from trompe_server.api.rate import RateLimit
from trompe_server.errors import ConflictError
from trompe_server.library import Library
from trompe_server.library.classification import Networks
from trompe_server.queue.leases import DISPATCHER, lease_holder, shares_store
from trompe_server.queue.store import JobStore
from trompe_server.settings import Settings
from trompe_server.storage.folders import Folder, JobArtifacts, job_artifacts
from trompe_server.storage.tokens import Tokens
from trompe_shared.addresses import without_password
from trompe_shared.api import RendererInfo

UPLOADS: Final = 2
"""Uploads that are read at the same time, since each may take a lot of memory. The others wait on disk."""
CLASSIFICATIONS: Final = 20.0
"""Requests for a classification per second of each token, or of each address without one."""


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
    metrics: HttpMetrics = field(default_factory=HttpMetrics)
    networks: Networks = field(default_factory=Networks)
    classifications: RateLimit = field(default_factory=lambda: RateLimit(CLASSIFICATIONS))
    uploads: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(UPLOADS))

    def artifacts(self, job: str) -> JobArtifacts:
        """The files of a job, for reading."""
        return job_artifacts(self.files, job)

    def check_store(self) -> None:
        """Raises ``ConflictError`` if the jobs are dispatched by a process with another store."""
        engine, url = self.store.engine, without_password(self.settings.store_url)
        holder = lease_holder(engine, DISPATCHER)
        if holder is not None and not shares_store(self.files, holder):
            raise ConflictError(
                f"{holder} runs the jobs of this database with another store than this service, which has {url}: it "
                "would not find the uploads. Start all services and workers of a database with the same --store "
                "(TROMPE_STORE)."
            )


def _services(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


ServicesDep = Annotated[Services, Depends(_services)]
