"""Problem details as pages for browsers; without a token, the sign-in page."""

import json
from http import HTTPStatus
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trompe_server.pages.serving import page

PROBLEM = b"application/problem+json"


class HtmlProblems:
    """Turns problem details into pages for requests that accept HTML."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or not _wants_a_page(Request(scope)):
            await self._app(scope, receive, send)
            return
        begin: Message | None = None
        body = b""

        async def send_page(message: Message) -> None:
            nonlocal begin, body
            if message["type"] == "http.response.start" and _is_problem(message):
                begin = message
            elif begin is None:
                await send(message)
            else:
                body += message.get("body", b"")
                if not message.get("more_body"):
                    await _as_page(Request(scope), begin["status"], body)(scope, receive, send)

        await self._app(scope, receive, send_page)


def _wants_a_page(request: Request) -> bool:
    return "text/html" in request.headers.get("accept", "") and not request.url.path.startswith("/v1/")


def _is_problem(message: Message) -> bool:
    return any(name.lower() == b"content-type" and value.startswith(PROBLEM) for name, value in message["headers"])


def _as_page(request: Request, status: int, body: bytes) -> Response:
    if status == HTTPStatus.UNAUTHORIZED:
        return RedirectResponse(f"/login?next={quote(request.url.path)}", status_code=303)
    problem = json.loads(body)
    return page(
        request,
        "problem.html",
        status=status,
        title=problem["title"],
        detail=problem.get("detail") or "There are no details.",
    )
