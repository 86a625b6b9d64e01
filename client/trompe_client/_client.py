"""The synchronous client: carries ``_core``'s requests by httpx, which no other module imports."""

import ipaddress
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Self, TypeVar, Unpack

import httpx

from trompe_client import _core
from trompe_client._core import Request
from trompe_client._errors import ServerUnreachable
from trompe_client._job import JobHandle
from trompe_client._plan import (
    AttackOptions,
    AttackPlan,
    Sources,
    Upload,
    background_upload,
    classifier_upload,
    object_upload,
    plan_attack,
)
from trompe_shared.api import ClassifierInfo, JobSpec, JobState, ObjectInfo
from trompe_shared.errors import SpecError

__all__ = ["DEFAULT_SERVER", "Client"]

DEFAULT_SERVER: Final = "http://127.0.0.1:8000"

T = TypeVar("T")


class Client:
    """A connection to a Trompe server. Use it as a context manager, or ``close`` it.

    ``timeout`` is how long the server may be silent, seconds. ``transport`` replaces the network (a mock, in tests).
    """

    def __init__(
        self, base_url: str = DEFAULT_SERVER, *, timeout: float = 60.0, transport: httpx.BaseTransport | None = None
    ) -> None:
        self.base_url = base_url.rstrip("/")
        if not self.base_url.startswith(("http://", "https://")):
            raise SpecError(f"The server's URL must begin with http:// or https://, got {base_url!r}.")
        # A proxy from the environment cannot reach a server on this very machine.
        trust_env = not _is_loopback(httpx.URL(self.base_url).host)
        self._http = httpx.Client(base_url=self.base_url, timeout=timeout, transport=transport, trust_env=trust_env)

    def attack(
        self,
        object: str | Path,
        *,
        label: str | int,
        classifier: str | Path = "tiny",
        ensemble: Sources = (),
        judges: Sources = (),
        background: Sources = "white",
        masks: Mapping[str, str | Path] | None = None,
        **options: Unpack[AttackOptions],
    ) -> JobHandle:
        """Submit an attack and return at once with a handle on the job.

        Args:
            object: path of a zip, of a folder with an .obj, or of an .obj; or the name or id of a stored object.
            label: the object's true class, a name or an index.
            classifier: path of a .pt2, TorchScript (.pt, .torchscript) or .onnx file; or the name or id of a stored
                classifier. Class names are read from ``<stem>.classes.json``, ``imagenet_classes.json`` or
                ``classes.json`` beside the file.
            ensemble: classifiers that are attacked together with it, given alike.
            judges: classifiers that only judge the result, given alike.
            background: "white", "black", "#rrggbb", or the path of a picture; each view draws one of several.
            masks: by the file name of a texture, the path of a picture of its size that is white where it may change.
            options: everything else about the attack, see ``JobSpec``.

        Raises ``ObjectError``, ``ClassifierError`` or ``SpecError`` for what is wrong on this side, ``APIError`` for
        what the server refuses, ``ServerUnreachable``.
        """
        plan = plan_attack(
            object,
            label=label,
            classifier=classifier,
            ensemble=ensemble,
            judges=judges,
            background=background,
            masks=masks or {},
            **options,
        )
        return self.start(plan)

    def start(self, plan: AttackPlan) -> JobHandle:
        """Upload a plan's files and submit its job."""
        spec = plan.spec(
            object=self._stored_object(plan.object),
            classifier=self._stored_classifier(plan.classifier),
            ensemble=[self._stored_classifier(member) for member in plan.ensemble],
            judges=[self._stored_classifier(judge) for judge in plan.judges],
            background=[self._stored_background(each) for each in plan.backgrounds],
            masks={texture: self._stored_background(picture) for texture, picture in plan.masks.items()},
        )
        return self.submit(spec)

    def submit(self, spec: JobSpec) -> JobHandle:
        """Submit a job whose object and classifiers are stored already."""
        return JobHandle(self, self.send(_core.submit(spec)))

    def job(self, job_id: str) -> JobHandle:
        """A handle on a job by its id. Raises ``NotFound``."""
        return JobHandle(self, self.send(_core.job(job_id)))

    def jobs(self, *, state: JobState | str | None = None) -> Iterator[JobHandle]:
        """Handles on all jobs (in ``state``), newest first; pages are fetched as they are reached."""
        cursor: str | None = None
        while True:
            page = self.send(_core.jobs(state=JobState(state) if state else None, cursor=cursor))
            yield from (JobHandle(self, job) for job in page.jobs)
            cursor = page.next_cursor
            if cursor is None:
                return

    def objects(self) -> list[ObjectInfo]:
        """The stored objects, those that come with Trompe included."""
        return self.send(_core.objects())

    def classifiers(self) -> list[ClassifierInfo]:
        """The stored classifiers, those that come with Trompe included."""
        return self.send(_core.classifiers())

    def upload_object(self, source: str | Path, *, name: str | None = None) -> ObjectInfo:
        """Store an object: a zip, a folder with an .obj, or an .obj file."""
        upload = replace(object_upload(Path(source)), form={"name": name} if name else {})
        return self.send(_core.upload_object(upload))

    def upload_classifier(
        self, source: str | Path, *, classes: list[str] | None = None, name: str | None = None
    ) -> ClassifierInfo:
        """Store a classifier's file; ``classes`` defaults to the names in a JSON file beside it."""
        return self.send(_core.upload_classifier(classifier_upload(source, classes=classes, name=name)))

    def upload_background(self, source: str | Path) -> str:
        """Store a picture; gives the id that ``JobSpec.background`` and ``JobSpec.masks`` take."""
        return self.send(_core.upload_background(background_upload(Path(source)))).id

    def _stored_object(self, source: Upload | str) -> str:
        return source if isinstance(source, str) else self.send(_core.upload_object(source)).id

    def _stored_classifier(self, source: Upload | str) -> str:
        return source if isinstance(source, str) else self.send(_core.upload_classifier(source)).id

    def _stored_background(self, source: Upload | str) -> str:
        return source if isinstance(source, str) else self.send(_core.upload_background(source)).id

    def send(self, request: Request[T]) -> T:
        """Send one request and read its answer. Raises ``ClientError``."""
        with self._translated():
            response = self._http.request(
                request.method,
                request.path,
                params=dict(request.params),
                headers=dict(request.headers) | ({"Content-Type": "application/json"} if request.json else {}),
                content=request.json,
                data=dict(request.upload.form) if request.upload else None,
                files={"file": (request.upload.filename, request.upload.data)} if request.upload else None,
            )
        _check(response, request)
        return request.read(response.content)

    def stream(self, request: Request[Any], *, timeout: float) -> Generator[str, None, None]:
        """Lines of an answer as they arrive; ``timeout`` is the longest silence between two, seconds."""
        with (
            self._translated(),
            self._http.stream(
                request.method,
                request.path,
                headers=dict(request.headers),
                timeout=httpx.Timeout(timeout),
            ) as response,
        ):
            if response.is_error:
                response.read()
            _check(response, request)
            yield from response.iter_lines()

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """httpx's errors of the network as our own."""
        try:
            yield
        except httpx.ConnectError as error:
            raise ServerUnreachable(
                f"No Trompe server answers at {self.base_url} ({error}). "
                "Start one with `trompe serve`, or give the right address (--server, TROMPE_SERVER, Client(url))."
            ) from error
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise ServerUnreachable(
                f"The connection to {self.base_url} broke ({type(error).__name__}: {error}). Look at the server's log."
            ) from error

    def close(self) -> None:
        """Close the connections; jobs go on."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


def _check(response: httpx.Response, request: Request[Any]) -> None:
    """Raise the error that a refusing answer stands for."""
    if response.status_code >= 300:
        request_id = response.headers.get("X-Request-ID")
        raise _core.error_from(response.status_code, response.content, request_id=request_id, job_id=request.job_id)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
