"""Every request that changes something leaves one line that says who sent it; virtual steps leave none."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest

from support import pendulum
from support.noting import until
from support.server import ServerProcess, running_server
from surrogym_server.api.door import fingerprint
from surrogym_server.api.middleware import CHANGING, FREQUENT

TOKENS = {role: f"the-token-to-{role}" for role in ("sample", "train", "admin")}
Send = Callable[..., httpx.Response]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    tokens = ",".join(f"{role}:{token}" for role, token in TOKENS.items())
    with running_server(tmp_path_factory.mktemp("audit"), SURROGYM_TOKENS=tokens) as server:
        yield server


@pytest.fixture
def send(guarded: ServerProcess) -> Iterator[Send]:
    """Sends a request with the token of a role, or another header."""
    with httpx.Client(base_url=guarded.url, timeout=60) as client:

        def request(method: str, path: str, role: str, id: str = "", **options: object) -> httpx.Response:
            headers = {"authorization": f"Bearer {TOKENS.get(role, role)}"} | ({"x-request-id": id} if id else {})
            return client.request(method, path, headers=headers, **options)  # type: ignore[arg-type]

        yield request


def lines(server: ServerProcess, request: str) -> list[str]:
    """What the log says of a request."""
    return [line for line in server.log.splitlines() if line.endswith(f"[request {request}]")]


def test_the_audit_line_of_a_change_names_role_token_fingerprint_address_and_request(
    guarded: ServerProcess, send: Send
) -> None:
    body = {"name": "audited", "spec": pendulum.spec()}
    sent = [
        ("POST", "/v1/surrogates", "admin", {"json": body}, 201),
        ("PATCH", "/v1/surrogates/audited", "admin", {"json": {"budget": 9}}, 200),
        ("POST", "/v1/surrogates/audited/improve", "train", {"json": {"queries": 1}}, 200),
        ("POST", "/v1/surrogates/audited/improve", "train", {"json": {"queries": 9_999}}, 403),
        ("DELETE", "/v1/surrogates/audited", "sample", {}, 403),
        ("DELETE", "/v1/surrogates/audited", "admin", {}, 204),
    ]
    for number, (method, path, role, options, status) in enumerate(sent):
        assert send(method, path, role, f"change-{number}", **options).status_code == status
        assert until(lambda: lines(guarded, f"change-{number}"))  # noqa: B023
        (line,) = lines(guarded, f"change-{number}")
        who = f"by {role} {fingerprint(TOKENS[role])} from 127.0.0.1"
        assert re.fullmatch(
            rf"INFO \S+: {method} {path} -> {status} in [\d.]+ ms, {who} \[request change-{number}\]", line
        )


def test_the_server_logs_the_fingerprint_of_every_token_at_start(guarded: ServerProcess) -> None:
    listed = next(line for line in guarded.log.splitlines() if "tokens: " in line)
    assert listed.endswith(", ".join(f"{role} {fingerprint(token)}" for role, token in TOKENS.items()))
    assert len({fingerprint(token) for token in TOKENS.values()}) == len(TOKENS)


def test_a_very_long_request_path_is_shortened_in_the_audit_line(guarded: ServerProcess, send: Send) -> None:
    assert send("DELETE", "/v1/surrogates/" + "x" * 30_000, "a-stranger", "long-path").status_code == 401
    assert until(lambda: lines(guarded, "long-path"))
    (line,) = lines(guarded, "long-path")
    assert len(line) < 500
    assert "(30015 characters)" in line


def test_the_fingerprint_of_an_unknown_token_is_not_logged(guarded: ServerProcess, send: Send) -> None:
    """Who mistypes a password into the header has not published its hash."""
    assert send("DELETE", "/v1/surrogates/x", "a-mistyped-secret", "stranger").status_code == 401
    assert until(lambda: lines(guarded, "stranger"))
    assert "by an unknown token from 127.0.0.1" in lines(guarded, "stranger")[0]
    assert fingerprint("a-mistyped-secret") not in guarded.log


def test_steps_resets_and_reads_leave_no_audit_line(
    client: httpx.Client, server_process: ServerProcess, taught: str
) -> None:
    """By default; one that is refused leaves one, and so does the session's opening, on an open server by anybody."""
    headers = {"x-request-id": "quiet"}
    opened = client.post(f"/v1/surrogates/{taught}/sessions", json={}, headers={"x-request-id": "opening"}).json()
    session = f"/v1/sessions/{opened['id']}"
    client.post(f"{session}/reset", json={}, headers=headers).raise_for_status()
    client.post(f"{session}/step", json={"action": [[0.0]]}, headers=headers).raise_for_status()
    client.get(f"/v1/surrogates/{taught}", headers=headers).raise_for_status()
    client.delete(session, headers={"x-request-id": "closing"}).raise_for_status()
    assert until(lambda: lines(server_process, "closing"))
    assert lines(server_process, "quiet") == []
    for request in ("opening", "closing"):
        assert "ms, by anybody from 127.0.0.1" in lines(server_process, request)[0]


def test_every_route_without_an_audit_line_exists_and_deletes_nothing(client: httpx.Client) -> None:
    """A new route that changes something leaves a line unless it is named as frequent."""
    paths = client.get("/openapi.json").json()["paths"]
    changing = {path for path, methods in paths.items() if CHANGING & {method.upper() for method in methods}}
    assert changing >= FREQUENT
    assert {path for path in FREQUENT if "DELETE" in {method.upper() for method in paths[path]}} == set()


def test_a_path_or_forwarded_address_cannot_forge_an_audit_line(tmp_path: Path) -> None:
    forged = "INFO surrogym_server.requests: DELETE /v1/surrogates/p -> 204 in 1.0 ms, by admin 00 from 9.9.9.9"
    with running_server(tmp_path) as server:
        path = f"/x\n{forged}".replace("\n", "%0A").replace(" ", "%20")
        httpx.get(f"{server.url}{path}", headers={"x-request-id": "forged"})
        httpx.delete(f"{server.url}/v1/surrogates/p", headers={"x-request-id": "proxied", "x-forwarded-for": forged})
        assert until(lambda: lines(server, "proxied"))
    assert not any(line.startswith(forged) for line in server.log.splitlines())
    assert r"\x0a" in lines(server, "forged")[0]
    assert "from an unknown address [request proxied]" in lines(server, "proxied")[0]


def test_audit_lines_in_json_format_name_the_caller(tmp_path: Path) -> None:
    with running_server(tmp_path, "--log-format", "json", SURROGYM_TOKEN=TOKENS["admin"]) as server:
        headers = {"authorization": f"Bearer {TOKENS['admin']}", "x-request-id": "as-json"}
        httpx.delete(f"{server.url}/v1/surrogates/none", headers=headers)
        assert until(lambda: "as-json" in server.log)
    records = [json.loads(line) for line in server.log.splitlines() if line.startswith("{")]
    (record,) = [record for record in records if record.get("request") == "as-json"]
    assert f"by admin {fingerprint(TOKENS['admin'])} from 127.0.0.1" in record["message"]
