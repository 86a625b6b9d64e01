"""The OpenAPI document: FastAPI's, completed."""

from typing import Any, Final

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from trompe_server.api.guard import OPEN_PATHS
from trompe_shared.api import Event, Problem

_REFERENCES: Final = "#/components/schemas/{model}"
_OF_FASTAPI: Final = ("HTTPValidationError", "ValidationError")


def contract(app: FastAPI) -> dict[str, Any]:
    """The document of ``app``, cached."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        _name_schemas(document["components"]["schemas"])
        _ask_for_tokens(document)
        for operations in document["paths"].values():
            for operation in operations.values():
                operation["responses"].pop("422", None)  # included in "4XX"
        app.openapi_schema = document
    return app.openapi_schema


def _name_schemas(schemas: dict[str, Any]) -> None:
    """Add models that no route declares, and remove FastAPI's own errors."""
    for model in (Event, Problem):
        schema = model.model_json_schema(ref_template=_REFERENCES)
        schemas |= schema.pop("$defs", {}) | {model.__name__: schema}
    for name in _OF_FASTAPI:
        schemas.pop(name, None)


def _ask_for_tokens(document: dict[str, Any]) -> None:
    """Declare the token: optional for all paths, none for open ones."""
    document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    document["security"] = [{"token": []}, {}]
    for path in OPEN_PATHS & set(document["paths"]):
        document["paths"][path]["get"]["security"] = []
