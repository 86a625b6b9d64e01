"""Requests of the contract and parsers of their answers. No I/O: any HTTP library can carry a ``Request``."""

import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

from pydantic import TypeAdapter, ValidationError

from trompe_client._errors import BY_STATUS, APIError, BadRequest, ContractError, ServerFault
from trompe_client._plan import Upload
from trompe_shared.api import (
    BackgroundInfo,
    ClassifierInfo,
    Event,
    Job,
    JobList,
    JobSpec,
    JudgementSpec,
    Manifest,
    ObjectInfo,
    Problem,
    RendererInfo,
    Result,
    WorkerInfo,
)
from trompe_shared.errors import SpecError
from trompe_shared.faults import faults_of

T = TypeVar("T")

SHORT_PAGE: Final = 50
"""Jobs on the first page of a list."""
LONG_PAGE: Final = 500
"""Jobs on further pages: the server's limit."""
PATHS: Final[dict[Any, str]] = {
    ObjectInfo: "/v1/objects",
    ClassifierInfo: "/v1/classifiers",
    BackgroundInfo: "/v1/backgrounds",
    WorkerInfo: "/v1/workers",
    RendererInfo: "/v1/renderers",
}


@dataclass(frozen=True)
class Request(Generic[T]):
    """One request, and the parser ``read`` of its answer's body.

    Every request is idempotent: new jobs carry a key, and the same bytes are stored once.
    """

    method: str
    path: str
    read: Callable[[bytes], T]
    params: tuple[tuple[str, str], ...] = ()
    headers: Mapping[str, str] = field(default_factory=dict)
    json: str | None = None
    upload: Upload | None = None
    job_id: str | None = None


def job_filter(labels: Mapping[str, str] | None, **words: str | None) -> list[tuple[str, str]]:
    """Query parameters of a list of jobs with all ``labels``; ``words``: state, object, classifier."""
    given = [(name, word) for name, word in words.items() if word is not None]
    return given + [("label", f"{name}:{value}") for name, value in (labels or {}).items()]


def store(upload: Upload, kind: type[T]) -> Request[T]:
    """Store a file; the answer is its record, an ``upload.kind``."""
    return Request("POST", PATHS[kind], _reader(kind), upload=upload)  # type: ignore[arg-type]


def listed(kind: type[T]) -> Request[list[T]]:
    """All records of a kind."""
    return Request("GET", PATHS[kind], _reader(list[kind]))  # type: ignore[valid-type]


def new_key() -> str:
    """A random idempotency key."""
    return secrets.token_hex(16)


def submit(spec: JobSpec | JudgementSpec, *, key: str) -> Request[Job]:
    """Submit a job; the same ``key`` makes one job. The queue's options of a plain spec have their defaults."""
    path = "/v1/judgements" if isinstance(spec, JudgementSpec) else "/v1/jobs"
    return Request("POST", path, _reader(Job), headers=_keyed(key), json=spec.model_dump_json())


def _keyed(key: str) -> dict[str, str]:
    """The header of an idempotency key. Headers are printable ASCII: other keys are percent-encoded."""
    return {"Idempotency-Key": key if key.isascii() and key.isprintable() else quote(key)}


def jobs(wanted: list[tuple[str, str]], *, limit: int, cursor: str | None = None) -> Request[JobList]:
    params = [*wanted, ("limit", str(limit)), *([("cursor", cursor)] if cursor else [])]
    return Request("GET", "/v1/jobs", _reader(JobList), params=tuple(params))


def job(job_id: str) -> Request[Job]:
    return Request("GET", _job_path(job_id), _reader(Job), job_id=job_id)


def cancel(job_id: str) -> Request[Job]:
    return Request("POST", f"{_job_path(job_id)}/cancel", _reader(Job), job_id=job_id)


def retry(job_id: str, *, key: str) -> Request[Job]:
    return Request("POST", f"{_job_path(job_id)}/retry", _reader(Job), headers=_keyed(key), job_id=job_id)


def delete(job_id: str) -> Request[None]:
    return Request("DELETE", _job_path(job_id), lambda _body: None, job_id=job_id)


def events(job_id: str, *, after: int | None) -> Request[bytes]:
    """Stream of the events after the one with the id ``after``."""
    resume = {} if after is None else {"Last-Event-ID": str(after)}
    headers = {"Accept": "text/event-stream", **resume}
    return Request("GET", f"{_job_path(job_id)}/events", bytes, headers=headers, job_id=job_id)


def result(job_id: str) -> Request[Result]:
    return Request("GET", f"{_job_path(job_id)}/result", _reader(Result), job_id=job_id)


def manifest(job_id: str) -> Request[Manifest]:
    path = f"/v1/judgements/{quote(job_id, safe='')}/manifest"
    return Request("GET", path, _reader(Manifest), job_id=job_id)


def artifact(job_id: str, name: str) -> Request[bytes]:
    return _file(job_id, f"artifacts/{quote(name)}")


def page(job_id: str) -> Request[str]:
    path = f"/jobs/{quote(job_id, safe='')}/result.html"
    return Request("GET", path, lambda body: body.decode(), job_id=job_id)


def archive(job_id: str) -> Request[bytes]:
    return _file(job_id, "archive")


def _file(job_id: str, path: str) -> Request[bytes]:
    """A file without content encoding, so that ranges and checksum are of its own bytes."""
    identity = {"Accept-Encoding": "identity"}
    return Request("GET", f"{_job_path(job_id)}/{path}", bytes, headers=identity, job_id=job_id)


def event(data: str) -> Event:
    """Parse the data of one server-sent event."""
    found: Event = _reader(Event)(data.encode())
    return found


def error_from(status: int, headers: Mapping[str, str], body: bytes, *, job_id: str | None) -> APIError:
    """The error of an answer. Quotes a body that is not a problem document."""
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError:
        said = f"answer was {body[:200].decode('utf-8', 'replace').strip() or '(empty)'!r}"
        if "Location" in headers:
            said = f"address redirects to {headers['Location']}; give the server's own address"
        problem = Problem(title=f"HTTP {status}, not from Trompe's API. The {said}", status=status)
    kind = BY_STATUS.get(status, ServerFault if status >= 500 else BadRequest)
    pause = _retry_after(headers.get("Retry-After"))
    return kind(problem, request_id=headers.get("X-Request-ID"), job_id=job_id, retry_after=pause)


def _retry_after(header: str | None) -> float | None:
    """Seconds to wait, from a number or an HTTP date."""
    if header is None or header.isdecimal():
        return None if header is None else float(header)
    from email.utils import parsedate_to_datetime  # rarely needed, and slow to import

    try:
        return max(0.0, (parsedate_to_datetime(header) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError):
        return None


def _job_path(job_id: str) -> str:
    if not (isinstance(job_id, str) and job_id):
        raise SpecError(f"Expected a job's id, got {job_id!r}.")
    return f"/v1/jobs/{quote(job_id, safe='')}"


@cache
def _reader(schema: Any) -> Callable[[bytes], Any]:
    """Parser of a JSON body; raises ``ContractError``."""
    adapter: TypeAdapter[Any] = TypeAdapter(schema)

    def read(body: bytes) -> Any:
        try:
            return adapter.validate_json(body)
        except ValidationError as error:
            raise ContractError(
                f"The server's answer does not fit the contract ({next(faults_of(error))}). Check that the address is "
                "a Trompe server's, and install the same version of trompe on both sides."
            ) from error

    return read
