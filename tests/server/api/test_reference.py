"""The page at /docs: all of the OpenAPI, without a script and without another host."""

from __future__ import annotations

import re
from html import unescape

import httpx
import pytest

from surrogym_server.api.openapi import page


@pytest.fixture(scope="module")
def docs(client: httpx.Client) -> httpx.Response:
    return client.get("/docs").raise_for_status()


def test_the_reference_page_lists_every_operation_and_schema(client: httpx.Client, docs: httpx.Response):
    openapi, text = client.get("/openapi.json").json(), unescape(docs.text)
    for path, methods in openapi["paths"].items():
        for method, operation in methods.items():
            assert f"<code>{method.upper()} {path}</code> {operation['summary']}" in text
    linked = set(re.findall(r'href="#([^"]+)"', docs.text))
    assert linked <= set(re.findall(r'id="([^"]+)"', docs.text)) == openapi["components"]["schemas"].keys()


def test_the_reference_page_loads_nothing_from_elsewhere_and_its_policy_forbids_it(docs: httpx.Response):
    assert not re.search(r"<script|<link|<img|<iframe|src=|https?://", docs.text)
    policy = docs.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert docs.headers["x-content-type-options"] == "nosniff"


def test_the_reference_page_escapes_html_in_descriptions():
    hostile = "<script>alert(1)</script>"
    operation = {"tags": [hostile], "summary": hostile, "description": hostile, "responses": {}}
    info = {"title": hostile, "version": "0", "description": hostile}
    schemas = {hostile: {"description": hostile, "properties": {hostile: {"enum": [hostile]}}}}
    openapi = {"info": info, "paths": {f"/{hostile}": {"get": operation}}, "components": {"schemas": schemas}}
    assert "<script" not in page(openapi)


def test_the_refusal_of_an_http_method_lists_the_allowed_methods(client: httpx.Client):
    assert client.put("/v1/surrogates/any").headers["allow"] == "DELETE, GET, PATCH"
    assert client.post("/").headers["allow"] == "GET"
