"""Two servers on one PostgreSQL: each fit is done by one of them, and each sees what the other has stored."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from support import pendulum
from support.postgresql import running_postgresql
from support.server import ServerProcess, running_server

SECONDS = 60.0

pytestmark = pytest.mark.postgresql


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[ServerProcess]]:
    folders: list[Path] = [tmp_path_factory.mktemp(name) for name in ("first", "second")]
    with running_postgresql() as postgresql:
        options = ("--database", postgresql.new_database())
        with running_server(folders[0], *options) as first, running_server(folders[1], *options) as second:
            yield [first, second]


@pytest.fixture
def clients(servers: list[ServerProcess]) -> Iterator[list[httpx.Client]]:
    with (
        httpx.Client(base_url=servers[0].url, timeout=SECONDS) as first,
        httpx.Client(base_url=servers[1].url, timeout=SECONDS) as second,
    ):
        yield [first, second]


def opened(client: httpx.Client, name: str) -> str:
    return client.post(f"/v1/surrogates/{name}/sessions", json={"num_envs": 1}).raise_for_status().json()["id"]


def reset(client: httpx.Client, session: str) -> httpx.Response:
    return client.post(f"/v1/sessions/{session}/reset", json={})


def version(client: httpx.Client, session: str) -> int:
    """The model that new episodes run under."""
    return int(reset(client, session).raise_for_status().json()["model_version"][0])


def fits(client: httpx.Client) -> float:
    families = text_string_to_metric_families(client.get("/metrics").text)
    return next(s.value for f in families for s in f.samples if s.name == "surrogym_fit_seconds_count")


def test_each_fit_is_done_once_and_seen_by_both(clients: list[httpx.Client]):
    first, second = clients
    view = pendulum.teach(first, "shared")
    sessions = [opened(client, "shared") for client in clients]
    assert [version(*pair) for pair in zip(clients, sessions, strict=True)] == [view["model_version"]] * 2
    second.post("/v1/surrogates/shared/improve", json={"queries": 1, "idempotency_key": "one"}).raise_for_status()
    while (after := pendulum.finish(second, "shared"))["model_version"] == view["model_version"]:
        time.sleep(0.05)
    assert [version(client, opened(client, "shared")) for client in clients] == [after["model_version"]] * 2
    deadline = time.monotonic() + SECONDS
    while [version(*pair) for pair in zip(clients, sessions, strict=True)] != [after["model_version"]] * 2:
        assert time.monotonic() < deadline, "open sessions see it as well, at their next episode"
        time.sleep(0.1)
    assert sum(fits(client) for client in clients) == after["model_version"]


def test_a_surrogate_deleted_and_made_anew_elsewhere_is_another_one(clients: list[httpx.Client]):
    first, second = clients
    pendulum.teach(first, "renewed")
    session = opened(second, "renewed")
    assert version(second, session) >= 1
    first.delete("/v1/surrogates/renewed").raise_for_status()
    pendulum.teach(first, "renewed")
    deadline = time.monotonic() + SECONDS
    while (reply := reset(second, session)).is_success:
        assert time.monotonic() < deadline, "the session ends with its surrogate"
        time.sleep(0.1)
    assert reply.status_code == 404
    assert version(second, opened(second, "renewed")) >= 1
