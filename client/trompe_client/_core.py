"""What is said to the server and how its answers are read. No I/O: any HTTP library can carry a ``Request``.

One function per request of the contract; ``_operations`` puts them together.
"""

import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

from pydantic import TypeAdapter, ValidationError

from trompe_client._errors import (
    APIError,
    BadRequest,
    Conflict,
    ContractError,
    Forbidden,
    NotFound,
    ServerFault,
    TooMany,
    Unauthorized,
)
from trompe_client._plan import Upload
from trompe_shared.api import (
    BackgroundInfo,
    ClassifierInfo,
    Event,
    Job,
    JobList,
    JobRequest,
    JobSpec,
    JobState,
    ObjectInfo,
    Problem,
    RendererInfo,
    Result,
    WorkerInfo,
)
from trompe_shared.faults import faults_of

T = TypeVar("T")

SHORT_PAGE: Final = 50
LONG_PAGE: Final = 500
"""Jobs on a page of a list: as many as people look at; and as many as a server gives."""


@dataclass(frozen=True)
class Request(Generic[T]):
    """One request, and ``read``, which makes the answer's body into a value.

    Every request of the contract can be sent twice with the effect of once: what makes a job carries a key, and what
    stores a file stores the same bytes once.
    """

    method: str
    path: str
    read: Callable[[bytes], T]
    params: tuple[tuple[str, str], ...] = ()
    headers: Mapping[str, str] = field(default_factory=dict)
    json: str | None = None
    upload: Upload | None = None
    job_id: str | None = None


@dataclass(frozen=True)
class JobFilter:
    """Which jobs to list: all those that are as it says."""

    state: JobState | None = None
    labels: Mapping[str, str] = field(default_factory=dict)
    object: str | None = None
    classifier: str | None = None

    def params(self) -> list[tuple[str, str]]:
        """As the parameters of a request."""
        words = {"state": self.state, "object": self.object, "classifier": self.classifier}
        given = [(name, str(word)) for name, word in words.items() if word is not None]
        return given + [("label", f"{name}:{value}") for name, value in self.labels.items()]


def upload_object(upload: Upload) -> Request[ObjectInfo]:
    return Request("POST", "/v1/objects", _reader(ObjectInfo), upload=upload)


def upload_classifier(upload: Upload) -> Request[ClassifierInfo]:
    return Request("POST", "/v1/classifiers", _reader(ClassifierInfo), upload=upload)


def upload_background(upload: Upload) -> Request[BackgroundInfo]:
    return Request("POST", "/v1/backgrounds", _reader(BackgroundInfo), upload=upload)


def objects() -> Request[list[ObjectInfo]]:
    return Request("GET", "/v1/objects", _reader(list[ObjectInfo]))


def classifiers() -> Request[list[ClassifierInfo]]:
    return Request("GET", "/v1/classifiers", _reader(list[ClassifierInfo]))


def backgrounds() -> Request[list[BackgroundInfo]]:
    return Request("GET", "/v1/backgrounds", _reader(list[BackgroundInfo]))


def workers() -> Request[list[WorkerInfo]]:
    return Request("GET", "/v1/workers", _reader(list[WorkerInfo]))


def renderers() -> Request[list[RendererInfo]]:
    return Request("GET", "/v1/renderers", _reader(list[RendererInfo]))


def new_key() -> str:
    """A key that no other job has: with it, a submission can be repeated and makes one job."""
    return secrets.token_hex(16)


def submit(spec: JobSpec, *, key: str) -> Request[Job]:
    """A job, made once for ``key``; all that a ``JobSpec`` leaves open has ``JobRequest``'s defaults."""
    body = JobRequest.of(spec).model_dump_json()
    return Request("POST", "/v1/jobs", _reader(Job), headers={"Idempotency-Key": key}, json=body)


def jobs(wanted: JobFilter, *, limit: int, cursor: str | None = None) -> Request[JobList]:
    params = [*wanted.params(), ("limit", str(limit)), *([("cursor", cursor)] if cursor else [])]
    return Request("GET", "/v1/jobs", _reader(JobList), params=tuple(params))


def job(job_id: str) -> Request[Job]:
    return Request("GET", _job_path(job_id), _reader(Job), job_id=job_id)


def cancel(job_id: str) -> Request[Job]:
    return Request("POST", f"{_job_path(job_id)}/cancel", _reader(Job), job_id=job_id)


def retry(job_id: str, *, key: str) -> Request[Job]:
    headers = {"Idempotency-Key": key}
    return Request("POST", f"{_job_path(job_id)}/retry", _reader(Job), headers=headers, job_id=job_id)


def delete(job_id: str) -> Request[None]:
    return Request("DELETE", _job_path(job_id), lambda _body: None, job_id=job_id)


def events(job_id: str, *, after: int | None) -> Request[bytes]:
    """The job's events as a stream; ``after`` is the id of the last one already seen."""
    resume = {} if after is None else {"Last-Event-ID": str(after)}
    headers = {"Accept": "text/event-stream", **resume}
    return Request("GET", f"{_job_path(job_id)}/events", bytes, headers=headers, job_id=job_id)


def result(job_id: str) -> Request[Result]:
    return Request("GET", f"{_job_path(job_id)}/result", _reader(Result), job_id=job_id)


def artifact(job_id: str, name: str) -> Request[bytes]:
    return _file(job_id, f"artifacts/{quote(name)}")


def archive(job_id: str) -> Request[bytes]:
    return _file(job_id, "archive")


def _file(job_id: str, path: str) -> Request[bytes]:
    """A file as it is: compressed on its way, neither its ranges nor its checksum would be those of its bytes."""
    identity = {"Accept-Encoding": "identity"}
    return Request("GET", f"{_job_path(job_id)}/{path}", bytes, headers=identity, job_id=job_id)


class EventParser:
    """Server-sent events, line by line (https://html.spec.whatwg.org/multipage/server-sent-events.html)."""

    def __init__(self) -> None:
        self._data: list[str] = []

    def feed(self, line: str) -> Event | None:
        """Take one line without its end; gives the event that the line completes, if it does."""
        if line.startswith("data:"):
            self._data.append(line[5:].removeprefix(" "))
        if line or not self._data:
            return None
        data, self._data = "\n".join(self._data), []
        event: Event = _reader(Event)(data.encode())
        return event


def error_from(status: int, headers: Mapping[str, str], body: bytes, *, job_id: str | None) -> APIError:
    """The error that a refusing answer stands for; a body that is no problem document is quoted."""
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError:
        said = body[:200].decode("utf-8", "replace").strip() or "(empty)"
        problem = Problem(
            title=f"HTTP {status}, not from Trompe's API", status=status, detail=f"The answer was {said!r}"
        )
    kind = _KINDS.get(status, ServerFault if status >= 500 else BadRequest)
    pause = _retry_after(headers.get("Retry-After"))
    return kind(problem, request_id=headers.get("X-Request-ID"), job_id=job_id, retry_after=pause)


_KINDS: Final[dict[int, type[APIError]]] = {
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    409: Conflict,
    429: TooMany,
}


def _retry_after(header: str | None) -> float | None:
    """Seconds to wait, from either form that the header can have."""
    if header is None or header.isdecimal():
        return None if header is None else float(header)
    from email.utils import parsedate_to_datetime  # rarely needed, and it brings much with it

    try:
        return max(0.0, (parsedate_to_datetime(header) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError):
        return None


def _job_path(job_id: str) -> str:
    return f"/v1/jobs/{quote(job_id, safe='')}"


@cache
def _reader(schema: Any) -> Callable[[bytes], Any]:
    """A function from a JSON body to ``schema``. The function raises ``ContractError``."""
    adapter: TypeAdapter[Any] = TypeAdapter(schema)

    def read(body: bytes) -> Any:
        try:
            return adapter.validate_json(body)
        except ValidationError as error:
            raise ContractError(
                f"The server's answer is not what this client expects ({next(faults_of(error))}). "
                "Is it a Trompe server? Install the same version of trompe on both sides."
            ) from error

    return read
