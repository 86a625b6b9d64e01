"""The errors of the client; those about inputs (``ObjectError``, ``SpecError``...) are shared with the server.

    TrompeError                      trompe_shared.errors
    └── ClientError                  has the ids it knows: request_id, job_id
        ├── ServerUnreachable        nothing answers at the server's address, or the connection broke
        ├── EmbeddedServerError      the service that a command starts for itself did not come up, or died
        ├── BrokenDownload           the bytes that came are not those that the server promised
        ├── ContractError            an answer that this client cannot read: another version, or no Trompe server
        ├── APIError                 the server said no: has status, problem
        │   ├── BadRequest           400, 413, 415, 422: what was sent is wrong
        │   ├── Unauthorized         401: a token is needed, or this one is not known
        │   ├── Forbidden            403: the token has not the right to do this
        │   ├── NotFound             404: no such job, object, classifier or file
        │   ├── Conflict             409: not possible in the present state
        │   ├── TooMany              429: too many requests; has retry_after
        │   └── ServerFault          5xx: the server's own fault
        └── JobError                 has job, as last seen
            ├── JobFailed            the job ended in an error
            ├── JobCancelled         somebody cancelled the job
            └── WaitTimeout          the job was still going on when the time was up; it goes on

A job that ends as n.a. (nothing was recognised before the attack) is a result, not an error.
"""

from typing import ClassVar

from trompe_shared.api import Job, Problem
from trompe_shared.errors import TrompeError

__all__ = [
    "APIError",
    "BadRequest",
    "BrokenDownload",
    "ClientError",
    "Conflict",
    "ContractError",
    "EmbeddedServerError",
    "Forbidden",
    "JobCancelled",
    "JobError",
    "JobFailed",
    "NotFound",
    "ServerFault",
    "ServerUnreachable",
    "TooMany",
    "Unauthorized",
    "WaitTimeout",
]


class ClientError(TrompeError):
    """Base of the client's own errors. ``request_id`` finds the request in the server's log."""

    code = "client"

    def __init__(self, message: str, *, request_id: str | None = None, job_id: str | None = None) -> None:
        super().__init__(message)
        self.request_id = request_id
        self.job_id = job_id


class ServerUnreachable(ClientError):  # noqa: N818
    """Nothing answers at the server's address, or the connection broke."""

    code = "unreachable"


class EmbeddedServerError(ClientError):
    """The service that a command starts for itself did not come up, or died."""

    code = "embedded-server"


class BrokenDownload(ClientError):  # noqa: N818
    """The bytes that came are not those that the server promised."""

    code = "broken-download"


class ContractError(ClientError):
    """An answer that this client cannot read."""

    code = "contract"


class APIError(ClientError):
    """The server refused a request. ``problem`` is its answer (RFC 9457), ``status`` the HTTP status.

    ``retry_after`` is how many seconds the server asks to be left in peace, where it says so.
    """

    code = "api"
    remedy: ClassVar[str] = ""
    """What helps, where the server does not know how its clients are told."""

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
    """What was sent is wrong; the message says what."""

    code = "bad-request"


class Unauthorized(APIError):  # noqa: N818
    """A token is needed, or this one is unknown or revoked. Give one by ``token=`` or TROMPE_TOKEN."""

    code = "unauthorized"
    remedy = "Give a token by TROMPE_TOKEN, --token or Client(token=...)."


class Forbidden(APIError):  # noqa: N818
    """The token has not the right to do this."""

    code = "forbidden"


class NotFound(APIError):  # noqa: N818
    """There is no such job, object, classifier or file."""

    code = "not-found"


class Conflict(APIError):  # noqa: N818
    """Not possible in the present state."""

    code = "conflict"


class TooMany(APIError):  # noqa: N818
    """Too many requests, and still so after some retries."""

    code = "too-many"


class ServerFault(APIError):  # noqa: N818
    """The server's own fault; its log has the request id."""

    code = "server-fault"


class JobError(ClientError):
    """A job did not come to a result. ``job`` is the job as last seen."""

    code = "job"

    def __init__(self, message: str, *, job: Job) -> None:
        super().__init__(message, job_id=job.id)
        self.job = job


class JobFailed(JobError):  # noqa: N818
    """The job ended in an error."""

    code = "job-failed"


class JobCancelled(JobError):  # noqa: N818
    """Somebody cancelled the job."""

    code = "job-cancelled"


class WaitTimeout(JobError):  # noqa: N818
    """The job was still going on when the time was up; it goes on."""

    code = "wait-timeout"


def _explain(problem: Problem) -> str:
    """One paragraph: title and detail, or what is wrong field by field where there is no detail."""
    fields = [f"{error.get('field')}: {error.get('message')}" for error in problem.errors or []]
    parts = [problem.title, *([problem.detail] if problem.detail else fields)]
    return ". ".join(part.rstrip(".") for part in parts) + "."
