"""Access control. Paths are closed unless listed as open, so that a new route is safe by default.

Without tokens the service is open, which ``serve`` allows on loopback only. Requests that a web page makes there are
recognised by two headers that pages cannot forge: ``Host`` and ``Origin``.
"""

import asyncio
import hmac
import ipaddress
import math
import time
from collections.abc import Mapping
from functools import partial
from typing import Final
from urllib.parse import SplitResult, urlsplit

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trompe_server.api.middleware import HttpMiddleware
from trompe_server.api.problems import RefusedError
from trompe_server.api.rate import RateLimit
from trompe_server.storage.database import DatabaseDownError
from trompe_server.storage.tokens import Right, Token, Tokens, hash_secret

OPEN_PATHS: Final = frozenset({"/docs", "/openapi.json", "/healthz", "/readyz", "/login", "/logout"})
"""Paths without a token: health, documentation, sign-in and sign-out."""
OPEN_FOLDER: Final = "/static/"
"""Static files of the pages."""
COOKIE: Final = "trompe_token"
"""Cookie with the token of a signed-in browser."""
UNLIMITED_PATHS: Final = frozenset({"/healthz"})
READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})
STORES_NOTHING: Final = frozenset({"/v1/classify"})
"""Paths whose POST is open to tokens that may only read."""
FRESH: Final = 1.0
"""Seconds between two reads of the tokens; a revoked token works no longer than that."""
_CREATE: Final = "`trompe token create NAME --right read|write` makes one."


class Guard(HttpMiddleware):
    """Admits requests by token and rate; without tokens, by origin. An open stream ends with its token."""

    def __init__(self, app: ASGIApp, *, tokens: Tokens, rate: float) -> None:
        super().__init__(app)
        self._tokens, self._limit = tokens, RateLimit(rate)
        self._known: Mapping[str, Token] = {}
        self._looked_up = -math.inf
        self._lock = asyncio.Lock()

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        token = await self._admit(Request(scope))
        if token is None:
            await self._app(scope, receive, send)
            return
        complete = False

        async def send_on(message: Message) -> None:
            nonlocal complete
            await send(message)
            complete = message["type"] == "http.response.body" and not message.get("more_body", False)

        await self._app(scope, partial(self._receive, receive, token), send_on)
        if not complete and await self._is_revoked(token):
            await send({"type": "http.response.body"})

    async def _receive(self, receive: Receive, token: Token) -> Message:
        """The next message of a request; its end once the token is revoked."""
        message = asyncio.ensure_future(receive())
        try:
            while not (await asyncio.wait({message}, timeout=FRESH))[0]:
                if await self._is_revoked(token):
                    return {"type": "http.disconnect"}
            return message.result()
        finally:
            message.cancel()

    async def _is_revoked(self, token: Token) -> bool:
        try:
            known = await self._fresh_tokens()
        except DatabaseDownError:
            return False
        return any(each.name == token.name and each.revoked is not None for each in known.values())

    async def _admit(self, request: Request) -> Token | None:
        """The token of a request, if it needs one. Raises ``RefusedError`` for a request to refuse."""
        path = request.scope["path"]  # not request.url.path: a forged Host header can change it
        address = request.client.host if request.client else "unknown"
        try:
            _check_origin(request)
            is_open = path in OPEN_PATHS or path.startswith(OPEN_FOLDER)
            token = None if is_open else await self._identify(request)
        except RefusedError:
            self._check_rate(address)
            raise
        if path not in UNLIMITED_PATHS:
            self._check_rate(address if token is None else f"token {token.name}")
        if token is not None:
            await self._check_right(token, request)
        return token

    async def _identify(self, request: Request) -> Token | None:
        """The token of a request; ``None`` if the service has none."""
        known = await self._fresh_tokens()
        if not known:
            _check_host(request)
            return None
        token = _find(known, _secret(request))
        if token is None or token.revoked is not None:
            raise _unauthorized(f"The token is unknown or revoked. {_CREATE}", ', error="invalid_token"')
        request.scope["token"] = token.name
        return token

    async def _check_right(self, token: Token, request: Request) -> None:
        reads = request.method in READING or request.scope["path"] in STORES_NOTHING
        if not reads and token.right is not Right.write:
            raise RefusedError(
                403,
                "read-only",
                f"The token {token.name!r} may only read, and {request.method} writes. {_CREATE}",
                WWW_Authenticate='Bearer realm="trompe", error="insufficient_scope", scope="write"',
            )
        if self._tokens.to_be_noted(token.name):
            await asyncio.to_thread(self._tokens.note_used, token.name)

    def _check_rate(self, client: str) -> None:
        wait = self._limit.wait(client)
        if wait:
            raise RefusedError(
                429,
                "too-many-requests",
                f"Too many requests; retry in {wait:.2f} s (limit: TROMPE_RATE_LIMIT).",
                Retry_After=str(math.ceil(wait)),
            )

    async def _fresh_tokens(self) -> Mapping[str, Token]:
        """The tokens, at most ``FRESH`` seconds old."""
        async with self._lock:
            if time.monotonic() - self._looked_up > FRESH:
                self._known = await asyncio.to_thread(self._tokens.by_hash)
                self._looked_up = time.monotonic()
            return self._known


def _secret(request: Request) -> str:
    """The secret in the request's header, or in the cookie of a signed-in browser."""
    if "authorization" not in request.headers and COOKIE in request.cookies:
        if request.method not in READING and "origin" not in request.headers:
            raise RefusedError(403, "other-origin", "A browser must send the header Origin with a write.")
        return request.cookies[COOKIE]
    scheme, _, secret = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" or not secret:
        raise _unauthorized("A token is required: send `Authorization: Bearer trompe_...`.")
    return secret.strip()


def _find(known: Mapping[str, Token], secret: str) -> Token | None:
    """The token with this secret, in constant time."""
    wanted = hash_secret(secret)
    found = [token for sha256, token in known.items() if hmac.compare_digest(sha256, wanted)]
    return found[0] if found else None


def _check_origin(request: Request) -> None:
    """Refuse a write by a page of another site."""
    origin = request.headers.get("origin")
    if origin is None or request.method in READING:
        return
    host = request.headers.get("host")
    if _split(origin).netloc != host:
        raise RefusedError(
            403, "other-origin", f"Pages of {origin} may not write at {host}. A proxy must pass on the header Host."
        )


def _check_host(request: Request) -> None:
    """Without tokens, refuse public host names, against DNS rebinding."""
    name = _split(f"//{request.headers.get('host', '')}").hostname or ""
    if "." in name and not _is_address(name):
        raise RefusedError(
            403, "other-host", f"Without tokens the service answers by its address only, not as {name!r}. {_CREATE}"
        )


def _split(url: str) -> SplitResult:
    try:
        return urlsplit(url)
    except ValueError as error:
        raise RefusedError(400, "no-address", f"{url[:80]!r} is not an address ({error}).") from error


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _unauthorized(detail: str, error: str = "") -> RefusedError:
    return RefusedError(401, "unauthorized", detail, WWW_Authenticate=f'Bearer realm="trompe"{error}')
