"""Two servers on one PostgreSQL: each fit is done by one of them, and each sees what the other has stored."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from support import pendulum
from support.postgresql import Postgresql
from support.server import ServerProcess, running_server
from surrogym_server.convert import definition_from_spec
from surrogym_server.services import claim_queues
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.notices import Notices
from surrogym_server.services.queries import QueryService
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.nouns import Query
from surrogym_shared.spec import EnvironmentSpec

SECONDS = 60.0

pytestmark = pytest.mark.postgresql


@pytest.fixture(scope="module")
def servers(postgresql: Postgresql, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[ServerProcess]]:
    folders: list[Path] = [tmp_path_factory.mktemp(name) for name in ("first", "second")]
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


def test_two_servers_on_one_database_do_each_fit_once_and_both_see_it(clients: list[httpx.Client]):
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


def test_a_session_ends_if_another_server_deletes_and_recreates_its_surrogate(clients: list[httpx.Client]):
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
    assert reply.status_code == 404, reply.text
    assert version(second, opened(second, "renewed")) >= 1


def test_a_sampler_waiting_at_one_server_gets_a_query_added_at_another(
    postgresql: Postgresql, monkeypatch: pytest.MonkeyPatch
):
    """By an announcement alone: the look from time to time is put off."""
    monkeypatch.setattr(claim_queues, "LOOK_SECONDS", 3_600.0)
    url = postgresql.new_database()
    storages = [open_storage(url) for _ in range(2)]
    spec = EnvironmentSpec.model_validate(pendulum.spec()).model_dump(mode="json")
    storages[0].surrogates.create(NewSurrogate("waited", spec, 10, 0.999))

    async def woken() -> int:
        definitions = Definitions(storages[0], lambda read: definition_from_spec(EnvironmentSpec.model_validate(read)))
        here, there = (QueryService(one, definitions, Notices(one.announcements)) for one in storages)
        waiting = asyncio.create_task(here.claim("waited", "sampler", 1, 60, SECONDS))
        while not (waiting.done() or listening(storages[0])):
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)  # it looks once, and then waits
        await asyncio.to_thread(there.add, "waited", [Query.step((0.0, 0.0), (0.0,))], None)
        return len((await asyncio.wait_for(waiting, SECONDS / 2)).queries)

    try:
        assert asyncio.run(woken()) == 1
    finally:
        for storage in storages:
            storage.close()


def listening(storage: Storage) -> bool:
    wanted = "SELECT 1 FROM pg_stat_activity WHERE starts_with(query, 'LISTEN') AND datname = current_database()"
    with storage._database.read() as connection:  # type: ignore[attr-defined]
        return len(connection.exec_driver_sql(wanted).all()) == 2
