"""The web pages. They show jobs; every action goes through the API."""

from fastapi import FastAPI
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles

from trompe_server.pages.routes import router
from trompe_server.pages.serving import STATIC, HtmlProblems
from trompe_shared.three import FOLDER

__all__ = ["add_pages"]


def add_pages(app: FastAPI) -> None:
    """Add the pages to ``app``, which serves the API. Problem details become pages for browsers."""
    app.include_router(router)
    for path, folder in {"/static/three": FOLDER, "/static": STATIC}.items():
        app.mount(path, GZipMiddleware(StaticFiles(directory=folder)), name=folder.name)
    app.add_middleware(HtmlProblems)
