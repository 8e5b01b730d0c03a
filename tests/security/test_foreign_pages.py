"""A page of another site, open in a browser on the server's machine, changes nothing: every route of the OpenAPI."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Page
from prometheus_client.parser import text_string_to_metric_families

from support import pendulum
from support.browser import find_chromium, launched
from support.noting import until
from support.server import ServerProcess, running_server

SAFE = ("GET", "HEAD")
PATH = "/v1/surrogates"

# What a page can send without asking the other side first, and one thing that a browser asks for.
SEND = """async ([url, method, body]) => {
  const tries = [
    {method: "POST", mode: "no-cors", body, headers: {"content-type": "text/plain"}},
    {method: "POST", mode: "no-cors", body: new Blob([body])},
    {method: "POST", mode: "no-cors", body: new URLSearchParams({body})},
    {method, mode: "cors", body: method === "DELETE" ? undefined : body, headers: {"content-type": "application/json"}},
  ];
  for (const one of tries) { try { await fetch(url, one); } catch (error) { /* no answer is for us to read */ } }
  navigator.sendBeacon(url, body);
}"""
FRAME = """async ([url]) => {
  const frame = document.createElement("iframe");
  frame.sandbox = "allow-scripts allow-forms";
  frame.srcdoc = `<script>fetch("${url}", {method: "POST", mode: "no-cors", body: "{}"}).catch(() => {})
    .finally(() => parent.postMessage("sent", "*"))</script>`;
  const sent = new Promise((done) => addEventListener("message", done, {once: true}));
  document.body.append(frame);
  await sent;
}"""
STREAM = """([url]) => new Promise((done) => {
  const stream = new WebSocket(url);
  stream.onopen = () => done("open");
  stream.onerror = () => done("refused");
})"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if find_chromium() is None:
        pytest.skip("Chromium is not on this machine, so foreign pages are not tried: apt-get install chromium")
    with launched() as found:
        yield found


@pytest.fixture
def foreign_page(browser: Browser, tmp_path: Path) -> Iterator[Page]:
    """A page that another server on this machine gave, under another name: another site for the browser."""
    (tmp_path / "index.html").write_text("<!doctype html><title>elsewhere</title><body></body>")

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path)) as elsewhere:
        threading.Thread(target=elsewhere.serve_forever, daemon=True).start()
        page = browser.new_page()
        page.goto(f"http://localhost:{elsewhere.server_port}/index.html")
        yield page
        page.close()
        elsewhere.shutdown()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("loopback")) as server:
        yield server


def requests_of(metrics: str) -> Counter[tuple[str, str, str]]:
    """How many requests a server has answered, by method, route and status."""
    return Counter(
        {
            (sample.labels["method"], sample.labels["route"], sample.labels["status"]): int(sample.value)
            for family in text_string_to_metric_families(metrics)
            for sample in family.samples
            if sample.name == "surrogym_request_seconds_count"
        }
    )


def changing(openapi: dict[str, Any]) -> list[tuple[str, str]]:
    parts = {"name": "pendulum", "id": "none", "query_id": 1, "job_id": 1, "version": 1, "form": "zip"}
    return [
        (method.upper(), path.format(**parts, alias="production"))
        for path, methods in openapi["paths"].items()
        for method in methods
        if method.upper() not in SAFE
    ]


def test_every_state_changing_route_refuses_requests_from_a_page_of_another_origin(
    server: ServerProcess, foreign_page: Page
):
    with httpx.Client(base_url=server.url, timeout=60) as client:
        client.post(PATH, json={"name": "pendulum", "spec": pendulum.spec()}).raise_for_status()
        routes = changing(client.get("/openapi.json").json())
        assert len(routes) > 15
        before = client.get(f"{PATH}/pendulum").json()
        known = requests_of(client.get("/metrics").text)
        for method, path in routes:
            foreign_page.evaluate(SEND, [server.url + path, method, "{}"])
        foreign_page.evaluate(FRAME, [f"{server.url}{PATH}/pendulum/models"])
        foreign_page.wait_for_timeout(500)  # beacons are sent when the browser likes
        said = requests_of(client.get("/metrics").text) - known
        assert client.get(f"{PATH}/pendulum").json() == before
    posted = {key: count for key, count in said.items() if key[0] not in ("GET", "OPTIONS")}
    assert {status for _, _, status in posted} == {"403"}, posted
    assert sum(posted.values()) >= 4 * len(routes), "each was sent, and refused"


def test_a_web_page_of_another_origin_cannot_open_a_stream(server: ServerProcess, foreign_page: Page):
    url = server.url.replace("http", "ws", 1)
    assert foreign_page.evaluate(STREAM, [f"{url}/v1/sessions/none/stream"]) == "refused"
    assert until(lambda: "/v1/sessions/none/stream -> 403" in server.log), "its line may come after the refusal"


def sent(url: str, **headers: str) -> int:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx.post(f"{url}{PATH}", json={}, headers=named, timeout=60).status_code


def test_the_servers_own_page_and_programs_can_send_state_changing_requests(server: ServerProcess):
    assert sent(server.url) == 422
    assert sent(server.url, origin=server.url, sec_fetch_site="same-origin") == 422
    for foreign in ("http://127.0.0.1:1", "https" + server.url[4:], "null", "http://evil.example"):
        assert sent(server.url, origin=foreign) == 403
    for site in ("cross-site", "same-site", "anything"):
        assert sent(server.url, sec_fetch_site=site) == 403


def test_behind_a_proxy_only_pages_of_the_public_url_can_send_state_changing_requests(tmp_path: Path):
    token = "the-token-behind-a-proxy"
    with running_server(tmp_path, "--public-url", "https://Plant.example", SURROGYM_TOKEN=token) as server:
        bearer = {"authorization": f"Bearer {token}"}
        assert sent(server.url, origin="https://plant.example", sec_fetch_site="same-origin", **bearer) == 422
        assert sent(server.url, origin="http://plant.example", **bearer) == 403
        assert sent(server.url, origin="null", **bearer) == 403, "with a token too"
