"""OpenAPI description of the app: FastAPI's, with the error replies that come from outside the routes.

``page`` shows it as one HTML page without scripts or external resources, so that it works offline.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from html import escape
from typing import Any

from fastapi import FastAPI, Request
from fastapi.openapi.utils import get_openapi
from fastapi.responses import Response
from starlette.routing import compile_path

from surrogym_server.api.door import JSON, SCHEMAS
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


STYLE = (
    "body{font:1rem/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color-scheme:light dark}"
    "code,pre{font-family:ui-monospace,monospace}pre{overflow:auto;padding:.5rem;border:1px solid #8886}"
    "table{border-collapse:collapse}td,th{text-align:left;vertical-align:top;padding:.1rem 1rem .1rem 0}"
    "details{margin:.5rem 0}summary{cursor:pointer}"
)
HEADERS = {
    "content-security-policy": (
        f"default-src 'none'; style-src 'sha256-{base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()}'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "referrer-policy": "no-referrer",
}


def page(openapi: dict[str, Any]) -> str:
    """Return the HTML page of an OpenAPI document: all operations by tag, then all schemas."""
    title = escape(f"{openapi['info']['title']} {openapi['info']['version']}")
    return "".join(
        [
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>',
            '<meta name="viewport" content="width=device-width"></head><body>',
            f"<h1>{title}</h1><p>{escape(openapi['info']['description'])}</p>",
            '<p>For programs: <a href="/openapi.json">/openapi.json</a>.</p>',
            *_operations(openapi),
            "<h2>Schemas</h2>",
            *(_schema(name, schema) for name, schema in sorted(openapi["components"]["schemas"].items())),
            "</body></html>",
        ]
    )


def _operations(openapi: dict[str, Any]) -> Iterator[str]:
    by_tag: dict[str, list[str]] = {}
    for path, methods in openapi["paths"].items():
        for method, operation in methods.items():
            by_tag.setdefault(operation["tags"][0], []).append(_operation(openapi, method, path, operation))
    for tag, texts in by_tag.items():
        yield f"<h2>{escape(tag)}</h2>" + "".join(texts)


def _operation(openapi: dict[str, Any], method: str, path: str, said: dict[str, Any]) -> str:
    parts = [f"<p>{escape(said['description'])}</p>"]
    if parameters := said.get("parameters"):
        rows = [(p["name"], f"{p['in']}: {_type(p['schema'])}", p.get("description", "")) for p in parameters]
        parts.append(_table("Parameters", rows))
    for media_type, content in said.get("requestBody", {}).get("content", {}).items():
        parts.append(f"<p>Body: <code>{escape(media_type)}</code> {_type(content.get('schema', {}))}</p>")
        if example := _example(content):
            parts.append(f"<pre>{escape(json.dumps(example, indent=1))}</pre>")
    parts.append(_table("Replies", [_reply(openapi, *reply) for reply in sorted(said["responses"].items())]))
    head = f"<code>{method.upper()} {escape(path)}</code> {escape(said['summary'])}"
    return f"<details><summary>{head}</summary>{''.join(parts)}</details>"


def _reply(openapi: dict[str, Any], status: str, reply: dict[str, Any]) -> tuple[str, str, str]:
    if "$ref" in reply:
        reply = openapi["components"]["responses"][reply["$ref"].rpartition("/")[2]]
    forms = [
        f"{escape(media)} {_type(content.get('schema', {}))}" for media, content in reply.get("content", {}).items()
    ]
    return status, "<br>".join(forms), reply["description"]


def _schema(name: str, schema: dict[str, Any]) -> str:
    required = schema.get("required", ())
    rows = [
        (field, _type(said) + ("" if field in required else ", optional"), said.get("description", ""))
        for field, said in schema.get("properties", {}).items()
    ]
    text = f"<p>{escape(schema.get('description', ''))}</p>" + (_table("Fields", rows) if rows else _type(schema))
    return f'<details id="{escape(name)}"><summary><code>{escape(name)}</code></summary>{text}</details>'


def _table(caption: str, rows: list[tuple[str, str, str]]) -> str:
    """Return an HTML table with rows of name, type and description."""
    lines = [
        f"<tr><td><code>{escape(name)}</code></td><td>{kind}</td><td>{escape(text)}</td></tr>"
        for name, kind, text in rows
    ]
    return f"<table><caption>{caption}</caption>{''.join(lines)}</table>"


def _example(content: dict[str, Any]) -> Any:
    named: dict[str, Any] = next(iter(content.get("examples", {}).values()), {})
    return content.get("example", named.get("value"))


def _type(schema: dict[str, Any]) -> str:
    """Describe a schema in a few words of HTML; a named schema becomes a link."""
    if reference := schema.get("$ref"):
        name = escape(reference.rpartition("/")[2])
        return f'<a href="#{name}">{name}</a>'
    for choice in ("anyOf", "oneOf", "allOf"):
        if choice in schema:
            return " or ".join(_type(part) for part in schema[choice])
    if "enum" in schema or "const" in schema:
        return " or ".join(escape(json.dumps(value)) for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    return escape(str(schema.get("format") or schema.get("type") or "any"))
