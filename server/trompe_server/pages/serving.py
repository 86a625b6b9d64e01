"""Templates, static files, and security headers of the pages."""

import hashlib
import re
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fastapi import Request
from fastapi.responses import HTMLResponse
from fastapi.templating import Jinja2Templates
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from trompe_server.api.guard import COOKIE
from trompe_shared import three

_HERE: Final = Path(__file__).parent
STATIC: Final = _HERE / "static"

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
    """Render a page."""
    values |= {"version": version("trompe"), "static": static, "signed_in": COOKIE in request.cookies}
    return _TEMPLATES.TemplateResponse(request, template, values, status_code=status, headers=HEADERS)


def render(template: str, /, **values: Any) -> str:
    """Render a part of a page."""
    return _TEMPLATES.get_template(template).render(values)
