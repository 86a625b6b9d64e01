"""The web application: routes, errors and documentation."""

from difflib import get_close_matches
from importlib.metadata import version
from typing import Final

from fastapi import Depends, FastAPI, Request

from trompe_server.api import classify, health, jobs, judgements, library
from trompe_server.api.contract import contract
from trompe_server.api.guard import Guard
from trompe_server.api.middleware import BodyLimit, Envelope, Head
from trompe_server.api.problems import answer_with_problems
from trompe_server.api.services import Services
from trompe_server.pages import add_pages
from trompe_shared.errors import SpecError

DESCRIPTION: Final = """Crafts adversarial 3D objects. Upload an object and a classifier (or use the shipped ones),
submit a job, follow its events, fetch its result. Errors are problem details (RFC 9457);
each response carries `X-Request-ID`. If the server has tokens, send `Authorization: Bearer trompe_...`."""


def create_app(services: Services) -> FastAPI:
    app = FastAPI(title="Trompe", version=version("trompe"), description=DESCRIPTION, docs_url=None, redoc_url=None)
    app.state.services = services
    # the last middleware is the outermost
    app.add_middleware(Head)
    app.add_middleware(BodyLimit, limit=services.settings.max_upload)
    app.add_middleware(Guard, tokens=services.tokens, rate=services.settings.rate_limit)
    app.add_middleware(Envelope, metrics=services.metrics)
    answer_with_problems(app)
    for router in (library.router, classify.router, jobs.router, judgements.router, jobs.experiments):
        app.include_router(router, dependencies=[Depends(_refuse_unknown)])
    app.include_router(health.router)
    add_pages(app)
    app.openapi = lambda: contract(app)  # type: ignore[method-assign]
    return app


async def _refuse_unknown(request: Request) -> None:
    """Raise ``SpecError`` for a query parameter that the route does not have: FastAPI ignores it."""
    known = [parameter.alias for parameter in request.scope["route"].dependant.query_params]
    for name in request.query_params:
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"{request.url.path} takes {', '.join(known) or 'none'}."
            raise SpecError(f"Unknown query parameter {name!r}; {hint}")
