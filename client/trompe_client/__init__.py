"""Thin client of a Trompe server. ``Client().attack(...)`` returns a job to wait for. Needs no torch and no numpy."""

from trompe_client._client import AsyncClient, Client
from trompe_client._errors import (
    APIError,
    BadRequest,
    BrokenDownload,
    ClientError,
    Conflict,
    ContractError,
    EmbeddedServerError,
    Forbidden,
    JobCancelled,
    JobError,
    JobFailed,
    NotFound,
    NotWritten,
    ServerFault,
    ServerUnreachable,
    TooMany,
    Unauthorized,
    WaitTimeout,
)
from trompe_client._job import AsyncJobHandle, JobHandle, ResultPage
from trompe_client._many import Attack, Outcome
from trompe_client._retry import Retries

__all__ = [
    "APIError",
    "AsyncClient",
    "AsyncJobHandle",
    "Attack",
    "BadRequest",
    "BrokenDownload",
    "Client",
    "ClientError",
    "Conflict",
    "ContractError",
    "EmbeddedServerError",
    "Forbidden",
    "JobCancelled",
    "JobError",
    "JobFailed",
    "JobHandle",
    "NotFound",
    "NotWritten",
    "Outcome",
    "ResultPage",
    "Retries",
    "ServerFault",
    "ServerUnreachable",
    "TooMany",
    "Unauthorized",
    "WaitTimeout",
]
