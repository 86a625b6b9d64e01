"""The web application: routes, errors and documentation put together."""

from importlib.metadata import version

from fastapi import FastAPI
from fastapi.responses import HTMLResponse, RedirectResponse

from trompe_server.api import health, jobs, library
from trompe_server.api.docs import DOCS_PAGE
from trompe_server.api.middleware import BodyLimit, RequestId
from trompe_server.api.problems import answer_with_problems
from trompe_server.api.services import Services

__all__ = ["create_app"]

DESCRIPTION = """Crafts adversarial 3D objects. Upload an object and a classifier (or use the shipped ones),
submit a job, follow its events, fetch its result. Errors are problem details (RFC 9457);
each response carries `X-Request-ID`."""


def create_app(services: Services) -> FastAPI:
    """The application over ``services``."""
    app = FastAPI(title="Trompe", version=version("trompe"), description=DESCRIPTION, docs_url=None, redoc_url=None)
    app.state.services = services
    app.add_middleware(BodyLimit, limit=services.settings.max_upload)
    app.add_middleware(RequestId)
    answer_with_problems(app)
    for router in (library.router, jobs.router, health.router):
        app.include_router(router)
    app.add_api_route("/", lambda: RedirectResponse("/docs"), include_in_schema=False)
    app.add_api_route("/docs", lambda: HTMLResponse(DOCS_PAGE), include_in_schema=False)
    return app
