"""Routes of the service itself: health, readiness, and its documentation."""

from __future__ import annotations

import re
from typing import Any

from fastapi import APIRouter, FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse, JSONResponse

from surrogym_server.api.auth import READ, Gate, bearer_token
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_shared.codes import Code, Problem
from surrogym_shared.wire import Access, Health, Ready

router = APIRouter(tags=["service"])

SCHEMAS = "#/components/schemas/{model}"


@router.get("/healthz", summary="That the process lives")
async def healthz(request: Request) -> Health:
    """Needs no token and no database."""
    return Health(version=request.app.version)


@router.get("/readyz", summary="That it can work", responses=documented(Code.UNAVAILABLE))
def readyz(use: Use) -> Ready:
    """Whether the database answers. Needs no token."""
    use.storage.ping()
    return Ready(status="ready", storage="ok")


@router.get("/v1/access", summary="What the caller may do", dependencies=[READ])
async def access(request: Request) -> Access:
    """The role of the token that came with the request."""
    gate: Gate = request.app.state.gate
    token = bearer_token(request.headers)
    return Access(role="admin" if gate.open or token is None else gate.role_of(token), tokens=not gate.open)


@router.get("/openapi.json", include_in_schema=False, dependencies=[READ])
async def openapi(request: Request) -> JSONResponse:
    return JSONResponse(describe(request.app))


@router.get("/docs", include_in_schema=False, dependencies=[READ])
async def docs(request: Request) -> HTMLResponse:
    return get_swagger_ui_html(openapi_url="/openapi.json", title=request.app.title)


def describe(app: FastAPI) -> dict[str, Any]:
    """OpenAPI of the app, the problem body included."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        problem = Problem.model_json_schema(ref_template=SCHEMAS)
        parts = schema["components"]["schemas"]
        parts.update(problem.pop("$defs", {}))
        parts["Problem"] = problem
        _drop_object_defaults(parts)
        _name_operations(schema["paths"])
        app.openapi_schema = schema
    return app.openapi_schema


def _name_operations(paths: dict[str, Any]) -> None:
    """Short names, such as ``surrogates_create``: generated clients call their functions so."""
    for path, methods in paths.items():
        for method, operation in methods.items():
            behind = re.sub(r"\W", "_", path) + f"_{method}"
            operation["operationId"] = f"{operation['tags'][0]}_{operation['operationId'].removesuffix(behind)}"


def _drop_object_defaults(node: Any) -> None:
    """Leave out defaults that are objects: their own fields say theirs, and generators of clients refuse them."""
    if isinstance(node, dict):
        if isinstance(node.get("default"), dict):
            del node["default"]
        for value in node.values():
            _drop_object_defaults(value)
    elif isinstance(node, list):
        for value in node:
            _drop_object_defaults(value)
