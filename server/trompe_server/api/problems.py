"""Every error as problem details (RFC 9457, application/problem+json)."""

import errno
import logging
import sqlite3
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from trompe_server.errors import ConflictError, NotFoundError, ServiceError
from trompe_server.storage.database import DatabaseDownError
from trompe_shared.api import Problem
from trompe_shared.errors import RendererError, TrompeError
from trompe_shared.faults import Fault, faults_of

logger = logging.getLogger(__name__)

RETRY_AFTER: Final = 5
"""Seconds until a retry, if a part of the service is down."""

_STATUS: Final[dict[type[TrompeError], int]] = {
    NotFoundError: 404,
    ConflictError: 409,
    ServiceError: 503,
    RendererError: 503,
}

_EXAMPLE: Final = {
    "type": "urn:trompe:unknown-label",
    "title": "Unprocessable Entity",
    "status": 422,
    "detail": "'tiny' has no class 'mag'; did you mean 'mug'? Give a class, its index, or another network.",
    "instance": "/v1/jobs",
    "request_id": "5f0c1e7a9b3d2846",
}

_SCHEMA: Final = {"$ref": "#/components/schemas/Problem"}

PROBLEMS: Final[dict[int | str, dict[str, Any]]] = {
    "4XX": {
        "description": "Refusal: problem details (RFC 9457)",
        "content": {"application/problem+json": {"schema": _SCHEMA, "example": _EXAMPLE}},
    }
}
"""Documentation of errors, for all routes."""


class RefusedError(Exception):
    """A refused request. ``code``: as of ``problem_response``. ``headers``: of the answer, with ``_`` for ``-``."""

    def __init__(self, status: int, code: str, detail: str, **headers: str) -> None:
        super().__init__(detail)
        self.status, self.code = status, code
        self.headers = {name.replace("_", "-"): value for name, value in headers.items()}


def answer_with_problems(app: FastAPI) -> None:
    """Make ``app`` answer its refusals with problem details. ``Envelope`` does so with all other errors."""
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, _http_error)


def problem_response(
    request: Request,
    status: int,
    *,
    detail: str,
    code: str | None = None,
    errors: list[dict[str, Any]] | None = None,
    headers: Mapping[str, str] | None = None,
) -> JSONResponse:
    """A response with problem details. ``code``: the error's short name, for programs."""
    problem = Problem(
        type=f"urn:trompe:{code}" if code else "about:blank",
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        instance=request.scope["path"],
        request_id=request.scope.get("request_id"),
        errors=errors,
    )
    return JSONResponse(
        problem.model_dump(mode="json", exclude_none=True),
        status_code=status,
        media_type="application/problem+json",
        headers=headers,
    )


async def _validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    errors = [{"field": _field(fault.place), "message": _message(fault)} for fault in faults_of(error.errors())]
    detail = "; ".join(f"{each['field']}: {each['message']}" for each in errors)
    return problem_response(request, 422, code="validation", detail=detail, errors=errors)


async def _http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    if _is_disk_full(error):
        return _disk_full(request, error)
    allowed = _methods(request) if error.status_code == 405 else ""
    headers = {"Allow": allowed} if allowed else error.headers
    return problem_response(request, error.status_code, detail=error.detail, headers=headers)


def _methods(request: Request) -> str:
    """Methods of all routes of the path; Starlette names those of the first. Empty for static files."""

    def has(method: str) -> bool:
        scope = {**request.scope, "method": method}
        return any(route.matches(scope)[0] is Match.FULL for route in request.app.routes)

    methods = list(filter(has, ("GET", "POST", "DELETE")))
    return ", ".join(methods + ["HEAD"] * ("GET" in methods))


def failure_response(request: Request, error: Exception) -> JSONResponse:
    """Answer to an exception: a refusal, an error of ours, a full disk, a database that is down, or a bug."""
    if isinstance(error, RefusedError):
        return problem_response(request, error.status, code=error.code, detail=str(error), headers=error.headers)
    if _is_disk_full(error):
        return _disk_full(request, error)
    if isinstance(error, PoolTimeoutError):
        error = DatabaseDownError("All connections of the database are in use; retry in a few seconds.")
    if isinstance(error, TrompeError):
        status = next((status for kind, status in _STATUS.items() if isinstance(error, kind)), 422)
        response = problem_response(request, status, code=error.code, detail=str(error))
        if status == 503:
            logger.warning("request %s: %s", request.scope.get("request_id"), error)
            response.headers["Retry-After"] = str(RETRY_AFTER)
        return response
    logger.error("request %s failed", request.scope.get("request_id"), exc_info=error)
    detail = "Internal error; see the server's log for this request id."
    return problem_response(request, 500, code="internal", detail=detail)


def _disk_full(request: Request, error: Exception) -> JSONResponse:
    logger.error("request %s: the disk is full: %s", request.scope.get("request_id"), error)
    general = "The server's disk is full; nothing of this request was stored. Its operator must free space."
    detail = str(error) if isinstance(error, TrompeError) else general
    return problem_response(request, 507, code="disk-full", detail=detail)


def _is_disk_full(error: BaseException | None) -> bool:
    """Whether the error, or one of its causes, is a full disk."""
    if error is None:
        return False
    return (
        (isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT})
        or getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
        or _is_disk_full(error.__cause__)
    )


def _message(fault: Fault) -> str:
    """The fault in words; FastAPI speaks of its own classes where a body is of another kind."""
    if fault.place == "body" and fault.kind == "model_attributes_type":
        return "Send a JSON object with the header Content-Type: application/json."
    if fault.message.startswith("Expected UploadFile"):
        return "Send a file with a name, not a text (curl: -F file=@PATH)."
    return fault.message


def _field(place: str) -> str:
    """Name of a field without the part of the request: body.paint.epsilon -> paint.epsilon."""
    part, _, inner = place.partition(".")
    return (inner if part in {"body", "query", "path", "header"} else place) or "body"
