"""Middleware, from the outside in: request ids, log and security headers; errors as problem details; body limit."""

import logging
import secrets
import time
from typing import Final

from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trompe_server.api.metrics import HttpMetrics
from trompe_server.api.problems import REQUEST_ID, failure_response, problem_response

logger = logging.getLogger(__name__)

HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Default headers of responses."""


class Envelope:
    """Gives each request an id, in ``scope["request_id"]`` and on the response, counts it and logs it.

    Logged seconds end at the start of the response, since a stream of events may last for hours.
    """

    def __init__(self, app: ASGIApp, *, metrics: HttpMetrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        identity = scope["request_id"] = secrets.token_hex(8)
        started = time.perf_counter()

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID] = identity
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                self._note(scope, message["status"], time.perf_counter() - started)
            await send(message)

        await self._app(scope, receive, send_with_headers)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        self._metrics.count(scope, status, seconds)
        wrote = scope["method"] not in {"GET", "HEAD"}
        logger.log(
            logging.INFO if wrote or status >= 500 else logging.DEBUG,
            "%s %s %d in %.0f ms",
            scope["method"],
            scope["path"],
            status,
            1000 * seconds,
            extra={"request": scope["request_id"], "token": scope.get("token"), "job": _job(scope)},
        )


class Failures:
    """Answers exceptions before the start of the response with problem details."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        begun = False

        async def send_and_note(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, send_and_note)
        except Exception as error:
            if begun or scope["type"] != "http":
                raise
            await failure_response(Request(scope), error)(scope, receive, send)


class BodyLimit:
    """Refuses bodies of more than ``limit`` bytes with 413, by announced and by actual size."""

    def __init__(self, app: ASGIApp, *, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        announced = dict(scope["headers"]).get(b"content-length", b"0")
        if announced.isdigit() and int(announced) > self._limit:
            await problem_response(Request(scope), 413, code="too-large", detail=self._refusal())(scope, receive, send)
            return
        received = 0

        async def receive_within_limit() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit:
                raise HTTPException(413, self._refusal())
            return message

        await self._app(scope, receive_within_limit, send)

    def _refusal(self) -> str:
        return f"The upload is larger than {self._limit / 2**20:g} MiB, the limit of this server (TROMPE_MAX_UPLOAD)."


def _job(scope: Scope) -> str | None:
    job: str | None = scope.get("path_params", {}).get("job")
    return job
