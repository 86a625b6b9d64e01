"""Errors of the client. Errors about inputs (``ObjectError``, ``SpecError``...) are shared with the server.

    TrompeError                      trompe_shared.errors
    └── ClientError                  knows request_id and job_id, if there are any
        ├── ServerUnreachable        no answer at the server's address, or a broken connection
        ├── EmbeddedServerError      the embedded service failed to start, or died
        ├── BrokenDownload           wrong checksum
        ├── NotWritten               the disk is full, or the file cannot be written
        ├── ContractError            unreadable answer: another version, or not a Trompe server
        ├── APIError                 refusal by the server: has status, problem, retry_after
        │   ├── BadRequest           400, 413, 415, 422: invalid request
        │   ├── Unauthorized         401: missing, unknown or revoked token
        │   ├── Forbidden            403: missing right
        │   ├── NotFound             404: no such job, object, classifier or file
        │   ├── Conflict             409: not possible in the current state
        │   ├── TooMany              429: too many requests
        │   └── ServerFault          5xx: error of the server
        └── JobError                 has job, as last seen
            ├── JobFailed            the job ended in an error
            ├── JobCancelled         the job was cancelled
            └── WaitTimeout          the job continues after the timeout

A job that ends as n.a. (nothing was recognised before the attack) is a result, not an error.
"""

import copyreg
import re
from typing import Any, ClassVar, Final

from trompe_shared.api import Job, Problem
from trompe_shared.errors import TrompeError


class ClientError(TrompeError):
    """Base of the client's own errors. ``request_id`` finds the request in the server's log.

    ``code`` is made from the class's name: ``not-found`` for ``NotFound``.
    """

    code = "client"

    def __init__(self, message: str, *, request_id: str | None = None, job_id: str | None = None) -> None:
        super().__init__(message)
        self.request_id = request_id
        self.job_id = job_id

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickle, which brings errors from worker processes: ``__init__`` takes other arguments than ``args``."""
        return copyreg.__newobj__, (type(self), *self.args), vars(self)  # type: ignore[attr-defined]

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "code" not in vars(cls):
            cls.code = re.sub("(?<=[a-z])(?=[A-Z])", "-", cls.__name__.removesuffix("Error")).lower()


class ServerUnreachable(ClientError):  # noqa: N818
    """No answer at the server's address, or a broken connection."""

    code = "unreachable"


class EmbeddedServerError(ClientError):
    """The embedded service failed to start, or died."""


class BrokenDownload(ClientError):  # noqa: N818
    """The checksum of a downloaded file differs from the server's."""


class NotWritten(ClientError):  # noqa: N818
    """A downloaded file cannot be written, for example to a full disk."""


class ContractError(ClientError):
    """The server's answer does not fit the contract."""


class APIError(ClientError):
    """The server refused a request. ``problem`` is its answer (RFC 9457), ``status`` the HTTP status.

    ``retry_after``: pause that the server asks for, seconds.
    """

    remedy: ClassVar[str] = ""
    """Added to the server's message."""

    def __init__(
        self,
        problem: Problem,
        *,
        request_id: str | None = None,
        job_id: str | None = None,
        retry_after: float | None = None,
    ) -> None:
        super().__init__(
            f"{_explain(problem)} {self.remedy}".strip(), request_id=request_id or problem.request_id, job_id=job_id
        )
        self.problem = problem
        self.status = problem.status
        self.retry_after = retry_after


class BadRequest(APIError):  # noqa: N818
    """The request is invalid."""


class Unauthorized(APIError):  # noqa: N818
    """The token is missing, unknown or revoked."""

    remedy = "Give a valid token, for example in TROMPE_TOKEN."


class Forbidden(APIError):  # noqa: N818
    """The token lacks the right."""


class NotFound(APIError):  # noqa: N818
    """No such job, object, classifier or file."""


class Conflict(APIError):  # noqa: N818
    """Not possible in the current state."""


class TooMany(APIError):  # noqa: N818
    """Too many requests, even after retries."""


class ServerFault(APIError):  # noqa: N818
    """Error of the server; its log has the request id."""


BY_STATUS: Final = {401: Unauthorized, 403: Forbidden, 404: NotFound, 409: Conflict, 429: TooMany}


class JobError(ClientError):
    """A job ended without a result. ``job`` is the job as last seen."""

    def __init__(self, message: str, *, job: Job) -> None:
        super().__init__(message, job_id=job.id)
        self.job = job


class JobFailed(JobError):  # noqa: N818
    """The job ended in an error."""


class JobCancelled(JobError):  # noqa: N818
    """The job was cancelled."""


class WaitTimeout(JobError):  # noqa: N818
    """The job continues after the timeout."""


def _explain(problem: Problem) -> str:
    """The detail, or else the title with the faults of the fields."""
    fields = [f"{error.get('field')}: {error.get('message')}" for error in problem.errors or []]
    parts = [problem.detail] if problem.detail else [problem.title, *fields]
    return ". ".join(part.rstrip(".") for part in parts) + "."
