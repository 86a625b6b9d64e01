"""Templates, static files, and security headers of the pages; problem details as pages."""

import hashlib
import json
import re
from functools import cache
from http import HTTPStatus
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from fastapi.templating import Jinja2Templates
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape
from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope, Send

from trompe_server.api.guard import COOKIE
from trompe_server.api.middleware import HttpMiddleware
from trompe_shared import three

_HERE: Final = Path(__file__).parent
STATIC: Final = _HERE / "static"
PROBLEM: Final = "application/problem+json"

HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; frame-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "Referrer-Policy": "same-origin",
}


def _code(text: str) -> Markup:
    """``text`` with words in backquotes, such as names of options, as code."""
    return Markup(re.sub("`+([^`]+)`+", r"<code>\1</code>", str(escape(text))))


_TEMPLATES: Final = Jinja2Templates(
    env=Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
)
_TEMPLATES.env.filters["code"] = _code


@cache
def static(name: str) -> str:
    """Address of a static file, with a hash of its content, so that browsers may cache it."""
    folder = three.FOLDER.parent if name.startswith(f"{three.FOLDER.name}/") else STATIC
    mark = hashlib.sha256((folder / name).read_bytes()).hexdigest()[:12]
    return f"/static/{name}?v={mark}"


def page(request: Request, template: str, /, status: int = 200, **values: Any) -> HTMLResponse:
    values |= {"version": version("trompe"), "static": static, "signed_in": COOKIE in request.cookies}
    return _TEMPLATES.TemplateResponse(request, template, values, status_code=status, headers=HEADERS)


def render(template: str, /, **values: Any) -> str:
    """Render a part of a page."""
    return _TEMPLATES.get_template(template).render(values)


class HtmlProblems(HttpMiddleware):
    """Turns problem details into pages for requests that accept HTML; without a token, the sign-in page."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope)
        if "text/html" not in request.headers.get("accept", "") or request.url.path.startswith("/v1/"):
            await self._app(scope, receive, send)
            return
        begin: Message | None = None
        body = b""

        async def send_page(message: Message) -> None:
            nonlocal begin, body
            if message["type"] == "http.response.start":
                kind = Headers(raw=message["headers"]).get("content-type", "")
                begin = message if kind.startswith(PROBLEM) else None
            if begin is None:
                await send(message)
            elif message is not begin:
                body += message.get("body", b"")
                if not message.get("more_body"):
                    await _as_page(request, begin, body)(scope, receive, send)

        await self._app(scope, receive, send_page)


def _as_page(request: Request, begin: Message, body: bytes) -> Response:
    """The page of a problem, with the headers of the answer that it replaces."""
    answer = _problem_page(request, begin["status"], body)
    for name, value in Headers(raw=begin["headers"]).items():
        if name not in {"content-type", "content-length"}:
            answer.headers.setdefault(name, value)
    return answer


def _problem_page(request: Request, status: int, body: bytes) -> Response:
    if status == HTTPStatus.UNAUTHORIZED:
        wanted = str(request.url.replace(scheme="", netloc=""))
        return RedirectResponse(f"/login?next={quote(wanted)}", status_code=303)
    problem = json.loads(body)
    return page(request, "problem.html", status=status, title=problem["title"], detail=problem["detail"])
