"""The client that blocks."""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar, Unpack

from trompe_client import _core
from trompe_client._core import JobFilter, Request
from trompe_client._job import JobHandle
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
from trompe_client._port import finish, iterate
from trompe_client._retry import Retries
from trompe_client._settings import DEFAULT_SERVER, Connection
from trompe_shared.api import BackgroundInfo, ClassifierInfo, JobSpec, JobState, ObjectInfo, RendererInfo, WorkerInfo

__all__ = ["DEFAULT_SERVER", "Client"]

T = TypeVar("T")


class Client:
    """A connection to a Trompe server. Use it as a context manager, or ``close`` it. Threads may share one.

    ``server`` is by default TROMPE_SERVER, else http://127.0.0.1:8000; ``token`` is by default TROMPE_TOKEN.
    ``timeout`` is how long the server may be silent, seconds; after an upload, which it reads first, 300 s more.
    ``transport`` replaces the network (a mock, in tests).

    Every method raises ``APIError`` for what the server refuses and ``ServerUnreachable``; what can be asked twice
    without harm is asked again as ``retries`` says, and that is nearly everything.
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
        from trompe_client._http import BlockingPort  # httpx is loaded only for those who connect

        connection = Connection.find(server, token=token, timeout=timeout, transport=transport)
        self.server = connection.url
        self.port = BlockingPort(connection, retries)

    def attack(
        self, object: str | Path, *, label: str | int, key: str | None = None, **options: Unpack[AttackOptions]
    ) -> JobHandle:
        """Submit an attack and return at once with a handle on the job.

        Args:
            object: path of a zip, of a folder with an .obj, or of an .obj; or the name or id of a stored object.
            label: the object's true class, a name or an index.
            key: with a key of its own an attack is made once, however often it is submitted.
            options: everything else about the attack, see ``AttackOptions``; ``classifier`` first of all.

        Raises ``ObjectError``, ``ClassifierError`` or ``SpecError`` for what is wrong on this side.
        """
        plan = partial(plan_attack, object, label=label, **options)
        return self.submit(finish(planned(self.port, plan)), key=key)

    def start(self, plan: AttackPlan, *, key: str | None = None) -> JobHandle:
        """Upload a plan's files and submit its job."""
        return self.submit(finish(uploaded(self.port, plan)), key=key)

    def submit(self, spec: JobSpec, *, key: str | None = None) -> JobHandle:
        """Submit a job whose object and classifiers are stored already: a ``JobRequest``, or a ``JobSpec``.

        Raises ``Conflict`` when another job was submitted with this ``key``.
        """
        return JobHandle(self, self.send(_core.submit(spec, key=key or _core.new_key())))

    def map(
        self, attacks: Iterable[Attack], *, batch: str | None = None, concurrency: int = 8
    ) -> Iterator[Outcome[JobHandle]]:
        """Submit many attacks, then give each as it ends, with its result or its error; none is raised.

        Nothing is submitted before the first outcome is asked for.

        Args:
            attacks: arguments of ``attack`` as mappings, or jobs for ``submit``. A file that several name is read and
                uploaded once.
            batch: a name for all of them, which the jobs carry as their label ``batch``. The same attacks under the
                same name again are found as they are: a script that was cut off goes on where it was. By default a new
                one.
            concurrency: requests at a time, not jobs.
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
        """Handles on all jobs that are as asked for, newest first; pages are fetched as they are reached.

        ``labels`` are those that a job must have; ``object`` and ``classifier`` are ids, or names of shipped ones.
        """
        wanted = JobFilter(JobState(state) if state else None, labels or {}, object, classifier)
        return (JobHandle(self, job) for job in iterate(pages(self.port, wanted)))

    def objects(self) -> list[ObjectInfo]:
        """The stored objects, those that come with Trompe included."""
        return self.send(_core.objects())

    def classifiers(self) -> list[ClassifierInfo]:
        """The stored classifiers, those that come with Trompe included."""
        return self.send(_core.classifiers())

    def backgrounds(self) -> list[BackgroundInfo]:
        """The uploaded pictures."""
        return self.send(_core.backgrounds())

    def workers(self) -> list[WorkerInfo]:
        """The processes that run jobs."""
        return self.send(_core.workers())

    def renderers(self) -> list[RendererInfo]:
        """The renderer workers that the server knows."""
        return self.send(_core.renderers())

    def upload_object(self, source: str | Path, *, name: str | None = None) -> ObjectInfo:
        """Store an object: a zip, a folder with an .obj, or an .obj file."""
        read = partial(named_object_upload, Path(source), name)
        return finish(uploaded_file(self.port, read, _core.upload_object))

    def upload_classifier(
        self, source: str | Path, *, classes: list[str] | None = None, name: str | None = None
    ) -> ClassifierInfo:
        """Store a classifier's file; ``classes`` defaults to the names in a JSON file beside it."""
        read = partial(classifier_upload, source, classes=classes, name=name)
        return finish(uploaded_file(self.port, read, _core.upload_classifier))

    def upload_background(self, source: str | Path) -> str:
        """Store a picture; gives the id that ``JobSpec.background`` and ``JobSpec.masks`` take."""
        read = partial(background_upload, Path(source))
        return finish(uploaded_file(self.port, read, _core.upload_background)).id

    def send(self, request: Request[T]) -> T:
        """Send one request and read its answer."""
        return finish(send(self.port, request))

    def close(self) -> None:
        """Close the connections; jobs go on."""
        self.port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
