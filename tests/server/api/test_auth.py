"""Closed by default: who may call what, and under which name."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from support import pendulum
from support.server import running_server
from surrogym_server import dashboard

ROLES = ("read", "train", "sample", "admin")
TOKENS = {role: f"the-token-to-{role}" for role in ROLES}
PUBLIC = {"/healthz", "/readyz", *dashboard.FILES}
BODIES = {
    "claim": ("POST", "/v1/surrogates/p/queries:claim", {"sampler": "s"}),
    "create": ("POST", "/v1/surrogates", {"name": "p", "spec": pendulum.spec()}),
    "open": ("POST", "/v1/surrogates/p/sessions", {}),
    "step": ("POST", "/v1/sessions/none/step", {"action": [0.0]}),
    "list": ("GET", "/v1/surrogates", None),
    "improve": ("POST", "/v1/surrogates/p/improve", {"queries": 1}),
    "pause": ("PATCH", "/v1/surrogates/p", {"paused": True}),
    "delete": ("DELETE", "/v1/surrogates/p", None),
    "ledger": ("POST", "/v1/surrogates/p/ledger", {"steps": 1, "idempotency_key": "k"}),
    "docs": ("GET", "/docs", None),
}
ALLOWED = {
    "claim": {"sample"},
    "create": set(),
    "open": {"train"},
    "step": {"train"},
    "list": {"read", "train", "sample"},
    "improve": {"train"},
    "pause": set(),
    "delete": set(),
    "ledger": {"train", "sample"},
    "docs": {"read", "train", "sample"},
}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A server with a token for each role, listening on every address."""
    tokens = ",".join(f"{role}:{token}" for role, token in TOKENS.items())
    folder = tmp_path_factory.mktemp("guarded")
    with (
        running_server(folder, "--host", "0.0.0.0", SURROGYM_TOKENS=tokens) as server,
        httpx.Client(base_url=server.url) as opened,
    ):
        yield opened


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("call", BODIES)
def test_a_role_may_do_its_part_alone(guarded: httpx.Client, role: str, call: str):
    method, path, body = BODIES[call]
    reply = guarded.request(method, path, json=body, headers={"authorization": f"Bearer {TOKENS[role]}"})
    if role in ALLOWED[call] | {"admin"}:
        assert reply.status_code not in (401, 403)
    else:
        assert (reply.status_code, reply.json()["code"]) == (403, "forbidden")


@pytest.mark.parametrize("role", ROLES)
def test_a_token_can_ask_for_its_role(guarded: httpx.Client, role: str):
    reply = guarded.get("/v1/access", headers={"authorization": f"Bearer {TOKENS[role]}"})
    assert reply.json() == {"role": role, "tokens": True}


def test_where_there_are_no_tokens_everybody_is_admin(client: httpx.Client):
    assert client.get("/v1/access").json() == {"role": "admin", "tokens": False}


@pytest.mark.parametrize("header", [None, "Bearer wrong", "Bearer", "Basic eDp5", TOKENS["admin"]])
def test_without_a_known_token_nothing_but_health_and_the_page(guarded: httpx.Client, header: str | None):
    headers = {"authorization": header} if header else {}
    schema = guarded.get("/openapi.json", headers={"authorization": f"Bearer {TOKENS['read']}"}).json()
    closed = [(m, path) for path, methods in schema["paths"].items() for m in methods if path not in PUBLIC]
    assert len(closed) > 20
    for method, path in [*closed, ("get", "/openapi.json"), ("get", "/docs")]:
        url = path.format(name="p", id="x", query_id=1, version=1)
        reply = guarded.request(method, url, headers=headers)
        assert (reply.status_code, reply.headers.get("www-authenticate")) == (401, "Bearer"), (method, path)


@pytest.mark.parametrize(
    ("header", "status"),
    [
        (None, 401),
        ("Bearer wrong", 401),
        (f"Bearer {TOKENS['sample']}", 403),
        (f"Bearer {TOKENS['train']}", 404),
        (f"Bearer {TOKENS['admin']}", 404),
    ],
)
def test_a_stream_authenticates_in_its_handshake(guarded: httpx.Client, header: str | None, status: int):
    """404, for there is no such session; a stranger is not told."""
    url = f"{str(guarded.base_url).replace('http', 'ws', 1)}/v1/sessions/x/stream"
    headers = {"Authorization": header} if header else {}
    with pytest.raises(InvalidStatus) as refused, connect(url, additional_headers=headers):
        pass
    assert refused.value.response.status_code == status


@pytest.mark.parametrize("path", sorted(PUBLIC))
def test_health_and_the_page_are_public(guarded: httpx.Client, path: str):
    assert guarded.get(path).status_code == 200


def test_the_page_may_load_nothing_from_elsewhere(guarded: httpx.Client):
    policy = guarded.get("/").headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8000", 200),
        ("localhost", 200),
        ("[::1]:9", 200),
        ("evil.example", 403),
        ("127.0.0.1.evil.example:8000", 403),
    ],
)
def test_a_name_pointed_at_this_machine_is_refused(client: httpx.Client, host: str, status: int):
    assert client.get("/v1/surrogates", headers={"host": host}).status_code == status
