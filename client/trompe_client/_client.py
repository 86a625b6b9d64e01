"""The blocking and the asynchronous client."""

from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

from trompe_client import _core
from trompe_client._core import Request
from trompe_client._job import AsyncJobHandle, JobHandle
from trompe_client._many import Attack, Outcome, run_all
from trompe_client._operations import pages, planned, send, stored, uploaded
from trompe_client._plan import (
    AttackPlan,
    background_upload,
    classifier_upload,
    object_upload,
    plan_attack,
    plan_judgement,
)
from trompe_client._port import Port, blocking, finish, iterate
from trompe_client._retry import Retries
from trompe_client._settings import Connection
from trompe_shared.api import (
    BackgroundInfo,
    ClassifierInfo,
    JobSpec,
    JobState,
    JudgementSpec,
    ObjectInfo,
    RendererInfo,
    WorkerInfo,
)

if TYPE_CHECKING:
    from trompe_client._http import AsyncPort, BlockingPort

Label = str | int | Sequence[str | int]
T = TypeVar("T")
P = TypeVar("P", bound=Port)


class _Connected(Generic[P]):
    """Connection of both clients."""

    port: P

    def __init__(
        self,
        server: str | None = None,
        *,
        token: str | None = None,
        timeout: float = 60.0,
        retries: Retries = Retries(),  # noqa: B008
        transport: Any = None,
    ) -> None:
        connection = Connection.find(server, token=token, timeout=timeout, transport=transport)
        self.server = connection.url
        self.port = self._open(connection, retries)

    def _open(self, connection: Connection, retries: Retries) -> P:
        raise NotImplementedError


class AsyncClient(_Connected["AsyncPort"]):
    """``Client`` for asyncio: the same arguments and methods. Use it by ``async with``, or ``close`` it."""

    def _open(self, connection: Connection, retries: Retries) -> "AsyncPort":
        from trompe_client._http import AsyncPort  # slow to import

        return AsyncPort(connection, retries)

    async def attack(
        self, object: str | Path, *, label: Label, key: str | None = None, **options: Any
    ) -> AsyncJobHandle:
        """As ``Client.attack``."""
        plan = partial(plan_attack, object, label=label, **options)
        return await self.submit(await planned(self.port, plan), key=key)

    async def judge(
        self, before: str | Path, after: str | Path, *, label: Label, key: str | None = None, **options: Any
    ) -> AsyncJobHandle:
        """As ``Client.judge``."""
        plan = partial(plan_judgement, before, after, label=label, **options)
        return await self.submit(await planned(self.port, plan), key=key)

    async def start(self, plan: AttackPlan, *, key: str | None = None) -> AsyncJobHandle:
        """As ``Client.start``."""
        return await self.submit(await uploaded(self.port, plan), key=key)

    async def submit(self, spec: JobSpec | JudgementSpec, *, key: str | None = None) -> AsyncJobHandle:
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
        wanted = _core.job_filter(labels, state=state or None, object=object, classifier=classifier)
        async for job in pages(self.port, wanted):
            yield AsyncJobHandle(self, job)

    async def objects(self) -> list[ObjectInfo]:
        """Stored objects, shipped ones included."""
        return await send(self.port, _core.listed(ObjectInfo))

    async def classifiers(self) -> list[ClassifierInfo]:
        """Stored classifiers, shipped ones included."""
        return await send(self.port, _core.listed(ClassifierInfo))

    async def backgrounds(self) -> list[BackgroundInfo]:
        """Uploaded pictures."""
        return await send(self.port, _core.listed(BackgroundInfo))

    async def workers(self) -> list[WorkerInfo]:
        """Attack workers: processes, or nodes of a cluster."""
        return await send(self.port, _core.listed(WorkerInfo))

    async def renderers(self) -> list[RendererInfo]:
        """Renderer workers of the server."""
        return await send(self.port, _core.listed(RendererInfo))

    async def upload_object(self, source: str | Path, *, name: str | None = None) -> ObjectInfo:
        """Store an object: a zip, a model file, or a folder with one."""
        return await stored(self.port, partial(object_upload, source, name=name), ObjectInfo)

    async def upload_classifier(
        self, source: str | Path, *, classes: list[str] | None = None, name: str | None = None
    ) -> ClassifierInfo:
        """Store a classifier's file. ``classes`` defaults to the names in a JSON file beside it."""
        read = partial(classifier_upload, source, classes=classes, name=name)
        return await stored(self.port, read, ClassifierInfo)

    async def upload_background(self, source: str | Path) -> str:
        """Store a picture. Returns its id, for the options ``background`` and ``masks`` of a ``JobSpec``."""
        return (await stored(self.port, partial(background_upload, Path(source)), BackgroundInfo)).id

    async def send(self, request: Request[T]) -> T:
        """Send one request and parse its answer."""
        return await send(self.port, request)

    async def close(self) -> None:
        """As ``Client.close``."""
        await self.port.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self.close()


class Client(_Connected["BlockingPort"]):
    """A connection to a Trompe server. Use it as a context manager, or ``close`` it. Threads may share one.

    Args:
        server: address; default: TROMPE_SERVER, else http://127.0.0.1:8000.
        token: access token; default: TROMPE_TOKEN.
        timeout: longest silence of the server, seconds; 300 s more after an upload.
        retries: limit and pauses of retries. Every request can be repeated safely.
        transport: an httpx transport in place of the network, for tests.

    Every method raises ``APIError`` for a refusal by the server, and ``ServerUnreachable``.
    """

    def _open(self, connection: Connection, retries: Retries) -> "BlockingPort":
        from trompe_client._http import BlockingPort  # slow to import

        return BlockingPort(connection, retries)

    def attack(self, object: str | Path, *, label: Label, key: str | None = None, **options: Any) -> JobHandle:
        """Submit an attack and return a handle on the job at once.

        Args:
            object: path of a zip, a model file or a folder with one; or the name or id of a stored object.
            label: the object's true class: a name or an index; or several that all count as the object.
            key: idempotency key; the same key makes one job.
            options: by the keywords of ``trompe_shared.api.OPTIONS``, listed in docs/sdk.md. ``classifier``,
                ``ensemble``, ``judges``, ``background`` and ``masks`` take names or paths. Class names are read from
                ``<stem>.classes.json``, ``imagenet_classes.json`` or ``classes.json`` beside a classifier's file.

        Raises ``ObjectError``, ``ClassifierError`` or ``SpecError`` for invalid files and options.
        """
        plan = partial(plan_attack, object, label=label, **options)
        return self.submit(finish(planned(self.port, plan)), key=key)

    def judge(
        self, before: str | Path, after: str | Path, *, label: Label, key: str | None = None, **options: Any
    ) -> JobHandle:
        """Submit a judgement of ``after``, a repaint of ``before`` by anyone, and return a handle at once.

        Args:
            before: path of a zip, a model file or a folder with one; or the name or id of a stored object.
            after: the same, or ``job:ID`` for the result of an attack.
            label: the object's true class: a name or an index; or several that all count as the object.
            key: idempotency key; the same key makes one judgement.
            options: the other fields of ``JudgementRequest``; ``networks`` takes names or paths.

        ``wait().manifest()`` has the figures, ``download`` gets manifest and page. Raises ``ObjectError``,
        ``ClassifierError`` or ``SpecError`` for invalid files and options.
        """
        plan = partial(plan_judgement, before, after, label=label, **options)
        return self.submit(finish(planned(self.port, plan)), key=key)

    def start(self, plan: AttackPlan, *, key: str | None = None) -> JobHandle:
        """Upload a plan's files and submit its job."""
        return self.submit(finish(uploaded(self.port, plan)), key=key)

    def submit(self, spec: JobSpec | JudgementSpec, *, key: str | None = None) -> JobHandle:
        """Submit an attack or a judgement of stored objects and classifiers, with or without options of the queue.

        Raises ``Conflict`` if another job was submitted with this ``key``.
        """
        return JobHandle(self, self.send(_core.submit(spec, key=key or _core.new_key())))

    def map(
        self, attacks: Iterable[Attack], *, batch: str | None = None, concurrency: int = 8
    ) -> Iterator[Outcome[JobHandle]]:
        """Submit many attacks and yield each as it ends, with its result or its error. Errors are not raised.

        Nothing is submitted before the first outcome is requested.

        Args:
            attacks: arguments of ``attack``, but ``key``, as mappings; or jobs for ``submit``. Each file is read and
                uploaded once.
            batch: name of the call; the jobs carry it as their label ``batch``. The same attacks under the same name
                find the existing jobs, so an interrupted script continues. Default: a new name.
            concurrency: number of simultaneous requests, not of jobs.
        """
        outcomes = iterate(run_all(self.port, list(attacks), batch=batch, concurrency=concurrency))
        return (outcome.of(partial(JobHandle, self)) for outcome in outcomes)

    def job(self, job_id: str) -> JobHandle:
        """A handle on a job by its id. Raises ``NotFound``."""
        return JobHandle(self, self.send(_core.job(job_id)))

    def jobs(
        self,
        *,
        state: JobState | str | None = None,
        labels: Mapping[str, str] | None = None,
        object: str | None = None,
        classifier: str | None = None,
    ) -> Iterator[JobHandle]:
        """Handles on all matching jobs, newest first; pages are fetched when they are reached.

        A job must have all ``labels``. ``object`` and ``classifier`` are ids, or names of shipped ones.
        """
        wanted = _core.job_filter(labels, state=state or None, object=object, classifier=classifier)
        return (JobHandle(self, job) for job in iterate(pages(self.port, wanted)))

    objects = blocking(AsyncClient.objects)
    classifiers = blocking(AsyncClient.classifiers)
    backgrounds = blocking(AsyncClient.backgrounds)
    workers = blocking(AsyncClient.workers)
    renderers = blocking(AsyncClient.renderers)
    upload_object = blocking(AsyncClient.upload_object)
    upload_classifier = blocking(AsyncClient.upload_classifier)
    upload_background = blocking(AsyncClient.upload_background)

    def send(self, request: Request[T]) -> T:
        """Send one request and parse its answer."""
        return finish(send(self.port, request))

    def close(self) -> None:
        """Close the connections. Jobs continue."""
        self.port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
