"""The OpenAPI document as one HTML page without scripts or external resources, so that it works offline."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator
from html import escape
from typing import Any

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
