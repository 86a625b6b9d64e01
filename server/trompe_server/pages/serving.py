"""How pages are put together: templates, files that go with them, and the headers that keep browsers strict."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fastapi import Request
from fastapi.responses import HTMLResponse
from fastapi.templating import Jinja2Templates
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from trompe_server.api.guard import COOKIE

__all__ = ["COOKIE", "STATIC", "page", "render"]

_HERE: Final = Path(__file__).parent
STATIC: Final = _HERE / "static"

HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "Referrer-Policy": "same-origin",
}

_TEMPLATES: Final = Jinja2Templates(
    env=Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
)


@cache
def _static(name: str) -> str:
    """Address of a file that goes with the pages; it changes with the file, so browsers may keep what they have."""
    mark = hashlib.sha256((STATIC / name).read_bytes()).hexdigest()[:12]
    return f"/static/{name}?v={mark}"


def page(request: Request, template: str, /, status: int = 200, **values: Any) -> HTMLResponse:
    """The page that ``template`` makes of ``values``."""
    values |= {"version": version("trompe"), "static": _static, "signed_in": COOKIE in request.cookies}
    return _TEMPLATES.TemplateResponse(request, template, values, status_code=status, headers=HEADERS)


def render(template: str, /, **values: Any) -> str:
    """A piece of a page."""
    return _TEMPLATES.get_template(template).render(values)
