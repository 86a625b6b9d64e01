"""Thin client of a Trompe server: ``Client(url).attack(...)`` gives a job to wait for. Needs no torch and no numpy."""

from trompe_client._client import Client
from trompe_client._errors import (
    APIError,
    BadRequest,
    ClientError,
    Conflict,
    ContractError,
    EmbeddedServerError,
    JobCancelled,
    JobError,
    JobFailed,
    NotFound,
    ServerFault,
    ServerUnreachable,
    WaitTimeout,
)
from trompe_client._job import JobHandle
from trompe_client._plan import AttackOptions

__all__ = [
    "APIError",
    "AttackOptions",
    "BadRequest",
    "Client",
    "ClientError",
    "Conflict",
    "ContractError",
    "EmbeddedServerError",
    "JobCancelled",
    "JobError",
    "JobFailed",
    "JobHandle",
    "NotFound",
    "ServerFault",
    "ServerUnreachable",
    "WaitTimeout",
]
