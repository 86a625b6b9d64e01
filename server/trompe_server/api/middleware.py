"""Middleware, from the outside in: request ids, log, security headers, errors as problem details; body limit."""

import asyncio
import logging
import secrets
import time
from typing import Final
from urllib.parse import quote

from fastapi import Request
from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.process_collector import ProcessCollector
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trompe_server.api.problems import RefusedError, failure_response

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
REQUEST_ID: Final = "X-Request-ID"
METHODS: Final = frozenset({"DELETE", "GET", "HEAD", "POST"})
FILE_PATHS: Final = frozenset({"/v1/objects", "/v1/classifiers", "/v1/backgrounds", "/v1/classify"})
"""Paths whose requests bring files, which are kept on disk while they are received."""
MAX_REQUEST: Final = 2**20
"""Largest body of any other request, bytes: it is read in memory, where JSON takes up to thirty times as much."""
BUCKETS: Final = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)


class HttpMiddleware:
    """Hands requests to ``serve``, and anything else straight to the application."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (self.serve if scope["type"] == "http" else self._app)(scope, receive, send)

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        raise NotImplementedError


class HttpMetrics:
    """Counts requests by route and status. One per application, since a process may have several."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self._requests = Counter(
            "trompe_http_requests", "Requests answered.", ["method", "route", "status"], registry=self.registry
        )
        self._seconds = Histogram(
            "trompe_http_request_seconds",
            "Seconds until the response began.",
            ["method", "route"],
            buckets=BUCKETS,
            registry=self.registry,
        )

    def count(self, scope: Scope, status: int, seconds: float) -> None:
        """Count one request by the pattern of its route, not by its path, so that labels stay few."""
        route = getattr(scope.get("route"), "path", "none")
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._requests.labels(method, route, status).inc()
        self._seconds.labels(method, route).observe(seconds)


class Envelope(HttpMiddleware):
    """Gives each request an id, in ``scope["request_id"]`` and on the response, counts it and logs it.

    Logged seconds end at the start of the response, since a stream of events may last for hours. Exceptions before it
    are answered with problem details.
    """

    def __init__(self, app: ASGIApp, *, metrics: HttpMetrics) -> None:
        super().__init__(app)
        self._metrics = metrics

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        identity = scope["request_id"] = secrets.token_hex(8)
        started, begun = time.perf_counter(), False

        async def send_with_headers(message: Message) -> None:
            nonlocal begun
            begun = True
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID] = identity
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                self._note(scope, message["status"], time.perf_counter() - started)
            await send(message)

        try:
            await self._app(scope, receive, send_with_headers)
        except Exception as error:
            if begun:
                raise
            await failure_response(Request(scope), error)(scope, receive, send_with_headers)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        self._metrics.count(scope, status, seconds)
        wrote = scope["method"] not in {"GET", "HEAD"}
        logger.log(
            logging.INFO if wrote or status >= 400 else logging.DEBUG,
            "%s %s %d in %.0f ms",
            scope["method"],
            quote(scope["path"]),
            status,
            1000 * seconds,
            extra={
                "request": scope["request_id"],
                "token": scope.get("token"),
                "job": scope.get("path_params", {}).get("job"),
            },
        )


class Head(HttpMiddleware):
    """Answers HEAD as GET, without the body: after the headers the application takes the client for gone."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        answered = asyncio.Event()

        async def send_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                scope["method"] = "HEAD"  # or the server awaits the body
                await send(message)
                await send({"type": "http.response.body"})
                answered.set()

        async def leave() -> Message:
            await answered.wait()
            return {"type": "http.disconnect"}

        scope["method"] = "GET"
        try:
            await self._app(scope, leave, send_headers)
        finally:
            scope["method"] = "HEAD"


class BodyLimit(HttpMiddleware):
    """Refuses bodies of more than ``limit`` bytes (uploads) or ``MAX_REQUEST`` with 413, announced and actual ones."""

    def __init__(self, app: ASGIApp, *, limit: int) -> None:
        super().__init__(app)
        self._limit = limit

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"] in FILE_PATHS:
            limit, what, whose = self._limit, "upload", "the limit of this server (TROMPE_MAX_UPLOAD)"
        else:
            limit, what, whose = MAX_REQUEST, "request", "the limit of requests without a file"
        refusal = f"The {what} is larger than {limit / 2**20:g} MiB, {whose}."
        announced = dict(scope["headers"]).get(b"content-length", b"0")
        if announced.isdigit() and int(announced) > limit:
            raise RefusedError(413, "too-large", refusal)
        received = 0

        async def receive_within_limit() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(413, refusal)
            return message

        await self._app(scope, receive_within_limit, send)
