"""Problem details as pages for browsers; without a token, the sign-in page."""

import json
from http import HTTPStatus
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import RedirectResponse, Response
from starlette.types import Message, Receive, Scope, Send

from trompe_server.api.middleware import HttpMiddleware
from trompe_server.pages.serving import page

PROBLEM = b"application/problem+json"


class HtmlProblems(HttpMiddleware):
    """Turns problem details into pages for requests that accept HTML."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope)
        if "text/html" not in request.headers.get("accept", "") or request.url.path.startswith("/v1/"):
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
                    await _as_page(request, begin["status"], body)(scope, receive, send)

        await self._app(scope, receive, send_page)


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
