"""What is said to the server and how its answers are read. No I/O: any HTTP library can carry a ``Request``.

One function per request of the contract; ``Client`` sends them, and so can any other shell.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import TypeAdapter, ValidationError

from trompe_client._errors import APIError, BadRequest, Conflict, ContractError, NotFound, ServerFault
from trompe_client._plan import Upload
from trompe_shared.api import (
    BackgroundInfo,
    ClassifierInfo,
    Event,
    Job,
    JobList,
    JobSpec,
    JobState,
    ObjectInfo,
    Problem,
    Result,
)

T = TypeVar("T")


@dataclass(frozen=True)
class Request(Generic[T]):
    """One request, and ``read``, which makes the answer's body into a value."""

    method: str
    path: str
    read: Callable[[bytes], T]
    params: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    json: str | None = None
    upload: Upload | None = None
    job_id: str | None = None


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


def submit(spec: JobSpec) -> Request[Job]:
    return Request("POST", "/v1/jobs", _reader(Job), json=spec.model_dump_json())


def jobs(*, state: JobState | None = None, cursor: str | None = None) -> Request[JobList]:
    params = {"state": state and state.value, "cursor": cursor}
    return Request("GET", "/v1/jobs", _reader(JobList), params={k: v for k, v in params.items() if v})


def job(job_id: str) -> Request[Job]:
    return Request("GET", _job_path(job_id), _reader(Job), job_id=job_id)


def cancel(job_id: str) -> Request[Job]:
    return Request("POST", f"{_job_path(job_id)}/cancel", _reader(Job), job_id=job_id)


def events(job_id: str, *, after: int | None) -> Request[bytes]:
    """The job's events as a stream; ``after`` is the id of the last one already seen."""
    resume = {} if after is None else {"Last-Event-ID": str(after)}
    headers = {"Accept": "text/event-stream", **resume}
    return Request("GET", f"{_job_path(job_id)}/events", bytes, headers=headers, job_id=job_id)


def result(job_id: str) -> Request[Result]:
    return Request("GET", f"{_job_path(job_id)}/result", _reader(Result), job_id=job_id)


def artifact(job_id: str, name: str) -> Request[bytes]:
    return Request("GET", f"{_job_path(job_id)}/artifacts/{quote(name)}", bytes, job_id=job_id)


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


def error_from(status: int, body: bytes, *, request_id: str | None, job_id: str | None) -> APIError:
    """The error that a refusing answer stands for; a body that is no problem document is quoted."""
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError:
        said = body[:200].decode("utf-8", "replace").strip() or "(empty)"
        problem = Problem(
            title=f"HTTP {status}, not from Trompe's API", status=status, detail=f"The answer was {said!r}"
        )
    kinds: dict[int, type[APIError]] = {404: NotFound, 409: Conflict}
    kind = kinds.get(status, ServerFault if status >= 500 else BadRequest)
    return kind(problem, request_id=request_id, job_id=job_id)


def _job_path(job_id: str) -> str:
    return f"/v1/jobs/{quote(job_id, safe='')}"


def _reader(schema: Any) -> Callable[[bytes], Any]:
    """A function from a JSON body to ``schema``. The function raises ``ContractError``."""

    def read(body: bytes) -> Any:
        try:
            return TypeAdapter(schema).validate_json(body)
        except ValidationError as error:
            raise ContractError(
                f"The server's answer is not what this client expects ({error.errors()[0]['msg']}). "
                "Is it a Trompe server? Install the same version of trompe on both sides."
            ) from error

    return read
