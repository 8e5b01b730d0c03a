"""OpenAPI description of the app: FastAPI's, with the error replies that come from outside the routes."""

from __future__ import annotations

import re
from typing import Any

from fastapi import FastAPI, Request
from fastapi.openapi.utils import get_openapi
from fastapi.responses import Response
from starlette.routing import compile_path

from surrogym_server.api.json_body import JSON, SCHEMAS
from surrogym_server.api.problems import documented, problem_response
from surrogym_shared.codes import Code, Problem

RESPONSES = "#/components/responses/{name}"

ANY_REQUEST = documented(
    Code.NOT_FOUND,
    Code.METHOD_NOT_ALLOWED,
    Code.REQUEST_TIMEOUT,
    Code.TOO_LARGE,
    Code.INVALID_REQUEST,
    Code.TOO_MANY_REQUESTS,
    Code.UNAVAILABLE,
)
WITH_TOKEN = documented(Code.UNAUTHENTICATED, Code.FORBIDDEN)


def install(app: FastAPI) -> None:
    """Make the app's reply 405 (method not allowed) list the methods of all routes that have the requested path."""
    app.add_exception_handler(405, _method_not_allowed)


async def _method_not_allowed(request: Request, _: Exception) -> Response:
    path = request.url.path
    paths = describe(request.app)["paths"].items()
    allowed = {method.upper() for known, said in paths if compile_path(known)[0].match(path) for method in said}
    detail = f"{request.method} is not allowed on {path!r}"
    return problem_response(Code.METHOD_NOT_ALLOWED, detail, headers={"allow": ", ".join(sorted(allowed or {"GET"}))})


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the complete OpenAPI description of the app; it is built once.

    Error replies that many routes share, such as that to a missing token, are described once under
    ``components/responses``, to which the routes refer.
    """
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        problem = Problem.model_json_schema(ref_template=SCHEMAS)
        components = schema["components"]
        components["schemas"].update(problem.pop("$defs", {}), Problem=problem)
        components["responses"] = {str(status): reply for status, reply in {**ANY_REQUEST, **WITH_TOKEN}.items()}
        _drop_object_defaults(components["schemas"])
        _name_operations(schema["paths"])
        for methods in schema["paths"].values():
            for operation in methods.values():
                _add_refusals(operation)
                components["schemas"].update(_parts_of_body(operation))
        app.openapi_schema = schema
    return app.openapi_schema


def _add_refusals(operation: dict[str, Any]) -> None:
    """Add the error replies that all routes share to an operation. A reply that the operation describes itself
    stays."""
    for status in (*ANY_REQUEST, *(WITH_TOKEN if "security" in operation else ())):
        operation["responses"].setdefault(str(status), {"$ref": RESPONSES.format(name=status)})


def _parts_of_body(operation: dict[str, Any]) -> dict[str, Any]:
    """Remove the schemas of nested models from the body of an operation, and return them for the components."""
    schema = operation.get("requestBody", {}).get("content", {}).get(JSON, {}).get("schema", {})
    parts: dict[str, Any] = schema.pop("$defs", {})
    return parts


def _name_operations(paths: dict[str, Any]) -> None:
    """Give operations short ids such as ``surrogates_create``, which generated clients use as function names."""
    for path, methods in paths.items():
        for method, operation in methods.items():
            behind = re.sub(r"\W", "_", path) + f"_{method}"
            operation["operationId"] = f"{operation['tags'][0]}_{operation['operationId'].removesuffix(behind)}"


def _drop_object_defaults(node: Any) -> None:
    """Remove defaults that are objects from a schema, because generators of clients refuse them. The fields of these
    objects have defaults themselves."""
    if isinstance(node, dict):
        if isinstance(node.get("default"), dict):
            del node["default"]
        for value in node.values():
            _drop_object_defaults(value)
    elif isinstance(node, list):
        for value in node:
            _drop_object_defaults(value)
