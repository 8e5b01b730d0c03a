"""Closed by default: who may call what, and under which name."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

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
ALLOWED = {
    "read train sample": """
        GET /v1/access, GET /metrics, GET /docs, GET /openapi.json, GET /v1/events, GET /v1/surrogates,
        GET /v1/surrogates/{name}, GET /v1/surrogates/{name}/queries, GET /v1/surrogates/{name}/samples,
        GET /v1/surrogates/{name}/models, GET /v1/surrogates/{name}/models/{version}, GET /v1/surrogates/{name}/events,
        GET /v1/surrogates/{name}/sessions, POST /v1/surrogates/{name}/query_uncertainty,
        POST /v1/surrogates/{name}/predict, POST /v1/surrogates/{name}/imagine, GET /v1/surrogates/{name}/snapshots,
        GET /v1/surrogates/{name}/dirt, GET /v1/surrogates/{name}/limits""",
    "train": """
        POST /v1/surrogates/{name}/sessions, POST /v1/surrogates/{name}/improve, GET /v1/sessions/{id},
        DELETE /v1/sessions/{id}, POST /v1/sessions/{id}/occupancy, POST /v1/sessions/{id}/reset,
        POST /v1/sessions/{id}/step, POST /v1/sessions/{id}/rollout, GET /v1/sessions/{id}/coordinates,
        POST /v1/surrogates/{name}/audit,
        POST /v1/surrogates/{name}/audit:withdraw""",
    "sample": """
        POST /v1/surrogates/{name}/queries, POST /v1/surrogates/{name}/queries:claim,
        POST /v1/surrogates/{name}/queries/{query_id}:renew, POST /v1/surrogates/{name}/queries/{query_id}:fail,
        POST /v1/surrogates/{name}/add_sample, POST /v1/surrogates/{name}/logs,
        POST /v1/surrogates/{name}/snapshots:drop""",
    "train sample": "POST /v1/surrogates/{name}/ledger",
    "": """
        POST /v1/surrogates, POST /v1/surrogates:check, POST /v1/logs:draft,
        PATCH /v1/surrogates/{name}, DELETE /v1/surrogates/{name},
        POST /v1/surrogates/{name}/models""",
}
ROLES_OF = {call.strip(): {*roles.split(), "admin"} for roles, calls in ALLOWED.items() for call in calls.split(",")}
for _part in Path(__file__).parents[1].glob("features/*/allowed.json"):
    for _roles, _calls in json.loads(_part.read_text()).items():
        ROLES_OF |= {call: {*_roles.split(), "admin"} for call in _calls}
UNDESCRIBED = {"GET /docs", "GET /openapi.json"}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A server with a token for each role, listening on every address."""
    tokens = ",".join(f"{role}:{token}" for role, token in TOKENS.items())
    folder = tmp_path_factory.mktemp("guarded")
    with (
        running_server(folder, "--host", "0.0.0.0", SURROGYM_TOKENS=tokens) as server,
        httpx.Client(base_url=server.url, timeout=60) as opened,
    ):
        yield opened


def called(client: httpx.Client, call: str, header: str | None) -> httpx.Response:
    """The head of a reply, with its body where it is a refusal; streams of events would not end."""
    method, path = call.split()
    url = path.format(name="none", id="none", query_id=1, job_id=1, version=1, which=1, form="zip", alias="a")
    headers = {"authorization": header} if header else {}
    with client.stream(method, url, json=None if method == "GET" else {}, headers=headers) as reply:
        if reply.is_error:
            reply.read()
        return reply


def test_every_route_has_an_expected_set_of_roles_in_this_test(guarded: httpx.Client):
    schema = guarded.get("/openapi.json", headers={"authorization": f"Bearer {TOKENS['read']}"}).json()
    found = {f"{method.upper()} {path}" for path, methods in schema["paths"].items() for method in methods}
    assert {call for call in found if call.split()[1] not in PUBLIC} | UNDESCRIBED == ROLES_OF.keys()


@pytest.mark.parametrize("call", ROLES_OF)
def test_each_token_role_may_call_exactly_its_routes(guarded: httpx.Client, call: str):
    """What is allowed goes on to fail by its content, for there is no such surrogate, or to succeed."""
    for role, token in TOKENS.items():
        reply = called(guarded, call, f"Bearer {token}")
        if role in ROLES_OF[call]:
            assert reply.status_code in (200, 204, 404, 415, 422), role
        else:
            assert (reply.status_code, reply.json()["code"]) == (403, "forbidden"), role


def test_a_train_token_cannot_raise_the_budget_and_an_admin_token_can(guarded: httpx.Client):
    """A real step costs money: who trains may not decide how many are taken."""
    train, admin = ({"authorization": f"Bearer {TOKENS[role]}"} for role in ("train", "admin"))
    guarded.post("/v1/surrogates", json={"name": "owned", "spec": pendulum.spec()}, headers=admin).raise_for_status()
    left = pendulum.BUDGET - pendulum.INITIAL
    path = "/v1/surrogates/owned/improve"

    def ask(queries: int, headers: dict[str, str]) -> httpx.Response:
        return guarded.post(path, json={"queries": queries}, headers=headers)

    refused = ask(left + 1, train)
    assert (refused.status_code, refused.json()["code"]) == (403, "beyond_budget")
    assert f"at most {left} more real steps" in refused.json()["detail"]
    assert "surrogym change owned --budget" in refused.json()["detail"]
    within = ask(left, train).raise_for_status().json()
    assert (within["budget"], within["budget_left"], within["budget_raised_by"]) == (pendulum.BUDGET, 0, 0)
    assert ask(1, train).status_code == 403
    raised = ask(3, admin).raise_for_status().json()
    assert (raised["budget"], raised["budget_raised_by"]) == (pendulum.BUDGET + 3, 3)
    guarded.delete("/v1/surrogates/owned", headers=admin).raise_for_status()


@pytest.mark.parametrize("role", ROLES)
def test_the_access_route_returns_the_role_of_the_token(guarded: httpx.Client, role: str):
    reply = guarded.get("/v1/access", headers={"authorization": f"Bearer {TOKENS[role]}"})
    assert reply.json() == {"role": role, "tokens": True}


def test_every_caller_is_admin_on_a_server_without_tokens(client: httpx.Client):
    assert client.get("/v1/access").json() == {"role": "admin", "tokens": False}


@pytest.mark.parametrize("header", [None, "Bearer wrong", "Bearer", "Basic eDp5", TOKENS["admin"]])
def test_requests_without_a_known_token_are_refused_on_all_protected_routes(guarded: httpx.Client, header: str | None):
    for call in ROLES_OF:
        reply = called(guarded, call, header)
        assert (reply.status_code, reply.headers.get("www-authenticate")) == (401, "Bearer"), call


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
def test_a_stream_without_a_valid_token_is_refused_at_the_websocket_handshake(
    guarded: httpx.Client, header: str | None, status: int
):
    """404, for there is no such session; a stranger is not told."""
    url = f"{str(guarded.base_url).replace('http', 'ws', 1)}/v1/sessions/x/stream"
    headers = {"Authorization": header} if header else {}
    with pytest.raises(InvalidStatus) as refused, connect(url, additional_headers=headers):
        pass
    assert refused.value.response.status_code == status


@pytest.mark.parametrize("path", sorted(PUBLIC))
def test_health_check_and_dashboard_page_need_no_token(guarded: httpx.Client, path: str):
    whole = guarded.get(path)
    assert whole.status_code == 200
    head = guarded.head(path)  # as wget --spider and load balancers ask
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-type"] == whole.headers["content-type"]


def test_the_dashboards_content_security_policy_forbids_other_origins(guarded: httpx.Client):
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
def test_an_unexpected_host_name_in_the_host_header_is_refused(client: httpx.Client, host: str, status: int):
    assert client.get("/v1/surrogates", headers={"host": host}).status_code == status
