"""What happens to every request: it gets an id, and a body that is too large is refused while it comes in."""

import secrets

from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trompe_server.api.problems import REQUEST_ID, problem_response

__all__ = ["BodyLimit", "RequestId"]


class RequestId:
    """Gives each request an id, in ``scope["request_id"]`` and on the response."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        identity = scope["request_id"] = secrets.token_hex(8)

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[REQUEST_ID] = identity
            await send(message)

        await self._app(scope, receive, send_with_id)


class BodyLimit:
    """Refuses bodies of more than ``limit`` bytes with 413, by what they announce and by what they turn out to be."""

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
        return f"The upload is larger than the {self._limit / 2**20:g} MiB that this server takes (TROMPE_MAX_UPLOAD)."
