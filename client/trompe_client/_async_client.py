"""The client for asyncio: ``Client``'s methods, to be awaited. What they mean is said there."""

from collections.abc import AsyncIterator, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar, Unpack

from trompe_client import _core
from trompe_client._core import JobFilter, Request
from trompe_client._job import AsyncJobHandle
from trompe_client._many import Attack, Outcome, run_all
from trompe_client._operations import pages, planned, send, uploaded, uploaded_file
from trompe_client._plan import (
    AttackOptions,
    AttackPlan,
    background_upload,
    classifier_upload,
    named_object_upload,
    plan_attack,
)
from trompe_client._retry import Retries
from trompe_client._settings import Connection
from trompe_shared.api import BackgroundInfo, ClassifierInfo, JobSpec, JobState, ObjectInfo, RendererInfo, WorkerInfo

__all__ = ["AsyncClient"]

T = TypeVar("T")


class AsyncClient:
    """A connection to a Trompe server for asyncio. Use it by ``async with``, or ``close`` it.

    Its arguments are ``Client``'s, and so are its methods.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        token: str | None = None,
        timeout: float = 60.0,
        retries: Retries = Retries(),  # noqa: B008
        transport: Any = None,
    ) -> None:
        from trompe_client._http import AsyncPort  # httpx is loaded only for those who connect

        connection = Connection.find(server, token=token, timeout=timeout, transport=transport)
        self.server = connection.url
        self.port = AsyncPort(connection, retries)

    async def attack(
        self, object: str | Path, *, label: str | int, key: str | None = None, **options: Unpack[AttackOptions]
    ) -> AsyncJobHandle:
        """As ``Client.attack``."""
        plan = partial(plan_attack, object, label=label, **options)
        return await self.submit(await planned(self.port, plan), key=key)

    async def start(self, plan: AttackPlan, *, key: str | None = None) -> AsyncJobHandle:
        """As ``Client.start``."""
        return await self.submit(await uploaded(self.port, plan), key=key)

    async def submit(self, spec: JobSpec, *, key: str | None = None) -> AsyncJobHandle:
        """As ``Client.submit``."""
        return AsyncJobHandle(self, await self.send(_core.submit(spec, key=key or _core.new_key())))

    async def map(
        self, attacks: Iterable[Attack], *, batch: str | None = None, concurrency: int = 8
    ) -> AsyncIterator[Outcome[AsyncJobHandle]]:
        """As ``Client.map``."""
        async for outcome in run_all(self.port, list(attacks), batch=batch, concurrency=concurrency):
            yield outcome.of(partial(AsyncJobHandle, self))

    async def job(self, job_id: str) -> AsyncJobHandle:
        """As ``Client.job``."""
        return AsyncJobHandle(self, await self.send(_core.job(job_id)))

    async def jobs(
        self,
        *,
        state: JobState | str | None = None,
        labels: Mapping[str, str] | None = None,
        object: str | None = None,
        classifier: str | None = None,
    ) -> AsyncIterator[AsyncJobHandle]:
        """As ``Client.jobs``."""
        wanted = JobFilter(JobState(state) if state else None, labels or {}, object, classifier)
        async for job in pages(self.port, wanted):
            yield AsyncJobHandle(self, job)

    async def objects(self) -> list[ObjectInfo]:
        """As ``Client.objects``."""
        return await self.send(_core.objects())

    async def classifiers(self) -> list[ClassifierInfo]:
        """As ``Client.classifiers``."""
        return await self.send(_core.classifiers())

    async def backgrounds(self) -> list[BackgroundInfo]:
        """As ``Client.backgrounds``."""
        return await self.send(_core.backgrounds())

    async def workers(self) -> list[WorkerInfo]:
        """As ``Client.workers``."""
        return await self.send(_core.workers())

    async def renderers(self) -> list[RendererInfo]:
        """As ``Client.renderers``."""
        return await self.send(_core.renderers())

    async def upload_object(self, source: str | Path, *, name: str | None = None) -> ObjectInfo:
        """As ``Client.upload_object``."""
        return await uploaded_file(self.port, partial(named_object_upload, Path(source), name), _core.upload_object)

    async def upload_classifier(
        self, source: str | Path, *, classes: list[str] | None = None, name: str | None = None
    ) -> ClassifierInfo:
        """As ``Client.upload_classifier``."""
        read = partial(classifier_upload, source, classes=classes, name=name)
        return await uploaded_file(self.port, read, _core.upload_classifier)

    async def upload_background(self, source: str | Path) -> str:
        """As ``Client.upload_background``."""
        read = partial(background_upload, Path(source))
        return (await uploaded_file(self.port, read, _core.upload_background)).id

    async def send(self, request: Request[T]) -> T:
        """As ``Client.send``."""
        return await send(self.port, request)

    async def close(self) -> None:
        """As ``Client.close``."""
        await self.port.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self.close()
