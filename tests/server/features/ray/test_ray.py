"""Sessions in a real Ray cluster of this machine, over a real PostgreSQL: the laws, and two front servers."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from support import pendulum
from support.alternating import alternating
from support.engine_laws import LAWS_OF_ENGINES, EngineCase
from support.postgresql import Postgresql
from support.server import ServerProcess, running_server
from surrogym_client.transport import HttpSurrogate, Transport
from surrogym_sampler.diagnosis.conformance import checks, conformance
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, Reply, Reset
from surrogym_server.errors import InvalidInput, SeqConflict, Unavailable
from surrogym_server.features.ray import pool
from surrogym_server.features.ray.host import Refused
from surrogym_server.features.ray.store import LiveSessions, SessionHolder
from surrogym_server.settings import Settings
from surrogym_server.storage.sql import Storage
from surrogym_shared.wire import OpenSession

ray = pytest.importorskip("ray")

NAME, HOSTS, LEASE = "pendulum", 2, 6.0  # of conftest.py
PACE = {"SURROGYM_RAY_LEASE_SECONDS": str(LEASE), "SURROGYM_RAY_CHECKPOINT_SECONDS": "0.1"}

pytestmark = [pytest.mark.postgresql, pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


@pytest.mark.parametrize("law", LAWS_OF_ENGINES, ids=lambda law: law.__name__)
def test_the_ray_session_engine_passes_the_engine_interface_tests(law, case: EngineCase):
    asyncio.run(law(case))


def test_ray_session_hosts_have_the_cpu_priority_that_docs_and_manifests_set(case: EngineCase, database: str):
    """The cluster of this module has the same variable. Without it Ray takes 15."""
    hosts = asyncio.run(about(database))
    own = os.getpriority(os.PRIO_PROCESS, 0)  # Ray's niceness comes on top
    assert {os.getpriority(os.PRIO_PROCESS, host.pid) for host in hosts} == {own}


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_session_continues_on_another_host_after_its_host_died_or_stopped(
    how: signal.Signals, case: EngineCase, storage: Storage, database: str, caplog: pytest.LogCaptureFixture
):
    """What was done since the last checkpoint is asked for again. A host that wakes has lost the session."""
    caplog.set_level("INFO")

    async def moved() -> None:
        session = await case.opened()
        requests: list[Advance] = [Reset(session, 1), *case.steps(session)]
        before = [await case.engine.advance(request) for request in requests[:7]][1:]
        number = int(session.rpartition(".")[2])
        [died] = [host for host in await about(database) if host.number == number]
        os.kill(died.pid, how)
        await replayed(case, requests[:8])
        holder = storage.part(LiveSessions).holder(session)
        assert holder is not None
        assert not holder.owner.startswith(f"{number} ")
        away = "has ended and is started again" if how is signal.SIGKILL else "does not answer now"
        assert caplog.text.count(f"session host {number} {away}") == 1
        assert f"session {session} goes on at session host {holder.owner.split()[0]}" in caplog.text
        after = [await case.engine.advance(request) for request in requests[7:]]
        if how is signal.SIGSTOP:
            os.kill(died.pid, signal.SIGCONT)
            late = await died.handle.ask.remote("advance", requests[-1])
            assert isinstance(late, Refused)
        await about(database)
        expected = [await case.engine.advance(request) for request in case.steps(await case.opened())]
        assert [step_of(reply) for reply in (*before, *after)] == [step_of(reply) for reply in expected]

    asyncio.run(moved())


@pytest.mark.parametrize("late", [False, True])
def test_a_long_request_is_awaited_while_its_session_host_lives(
    case: EngineCase, monkeypatch: pytest.MonkeyPatch, late: bool
):
    """As long as its host renews the lease, or is late with that and lives."""
    looks, look = [], LiveSessions.holder

    def holder(live: LiveSessions, id: str) -> SessionHolder | None:
        looks.append(id)
        found = look(live, id)
        return replace(found, seconds_left=-1.0) if found and late else found

    monkeypatch.setattr(LiveSessions, "holder", holder)
    monkeypatch.setattr(case.engine, "_patience", 1e-3)

    async def waited() -> None:
        session = await case.opened()
        asked = case.policy(session, 2)
        reply = await case.engine.advance(replace(asked, run=replace(asked.run, steps=500)))
        assert reply.seq == 2
        assert looks.count(session) > 2

    asyncio.run(waited())


def test_opening_a_session_on_an_unresponsive_host_is_refused(
    case: EngineCase, postgresql: Postgresql, database: str, monkeypatch: pytest.MonkeyPatch
):
    """The host stops while it waits for the database, which a lock holds up. The repeat opens one session."""
    monkeypatch.setattr(case.engine, "_patience", 0.5)
    monkeypatch.setattr("surrogym_server.features.ray.engine.ANSWERING_SECONDS", 1.0)

    async def stopped() -> None:
        hosts = await about(database)
        with postgresql.connect(str(sa.make_url(database).database)) as other, other.transaction():
            other.execute("LOCK TABLE live_sessions IN SHARE MODE")
            opening = asyncio.create_task(case.engine.open(case.asked(key="stopped")))
            while not other.execute("SELECT 1 FROM pg_locks WHERE NOT granted").fetchone():
                await asyncio.sleep(0.01)
            for host in hosts:
                os.kill(host.pid, signal.SIGSTOP)
        try:
            async with asyncio.timeout(60):
                with pytest.raises(Unavailable, match=r"session host \d does not answer now"):
                    await opening
        finally:
            for host in hosts:
                os.kill(host.pid, signal.SIGCONT)
        async with asyncio.timeout(60):
            while True:
                with suppress(Unavailable):
                    first, second = [await case.engine.open(case.asked(key="stopped")) for _ in range(2)]
                    break
                await asyncio.sleep(0.1)
        assert first.id == second.id

    asyncio.run(stopped())


def test_an_unresponsive_session_host_is_left_out_of_counts_and_lists(
    case: EngineCase, database: str, monkeypatch: pytest.MonkeyPatch
):
    """The view of each surrogate has them, also in the answer to a request that has created it."""
    monkeypatch.setattr("surrogym_server.features.ray.engine.ANSWERING_SECONDS", 1.0)
    sessions = [asyncio.run(case.opened()) for _ in range(HOSTS)]
    held, before = sessions[0].rpartition(".")[2], case.engine.counts().sessions[NAME]
    [stopped] = [host for host in asyncio.run(about(database)) if str(host.number) == held]
    lives, asked = case.engine._lives, set[int]()  # type: ignore[attr-defined]

    async def lived(host: int) -> bool:
        first = host not in asked
        asked.add(host)
        return first or bool(await lives(host))

    monkeypatch.setattr(case.engine, "_patience", 0.5)
    monkeypatch.setattr(case.engine, "_lives", lived)  # as if the host had stopped after it answered
    os.kill(stopped.pid, signal.SIGSTOP)
    try:
        assert 0 < case.engine.counts().sessions[NAME] < before
        assert sessions[0] not in [one.session.id for one in asyncio.run(case.engine.activity(NAME))]
    finally:
        os.kill(stopped.pid, signal.SIGCONT)


def test_a_session_of_another_host_pool_is_refused_with_the_reason(
    settings: Settings, case: EngineCase, storage: Storage, postgresql: Postgresql
):
    """A front server that writes the database's address in another way has session hosts of its own."""
    database = f"{settings.database}/"  # of the folder of PostgreSQL's socket
    other = pool.connect(settings.model_copy(update={"database": database, "ray_hosts": 1}), storage)

    async def asked() -> None:
        session = await case.opened(key="of one pool")
        for request in (other.describe(session), other.open(case.asked(key="of one pool"))):
            with pytest.raises(Unavailable, match="expected the same Ray cluster and the same --database"):
                await request

    try:
        asyncio.run(asked())
    finally:
        ray.kill(ray.get_actor(f"session host 0 of {pool.pool_name(database)}"))


@dataclass(frozen=True)
class Found:
    number: int
    pid: int
    handle: Any


async def about(database: str) -> list[Found]:
    """The hosts of the pool, once all of them run."""
    names = [f"session host {number} of {pool.pool_name(database)}" for number in range(HOSTS)]
    handles = [ray.get_actor(name) for name in names]
    async with asyncio.timeout(300):
        while True:
            with suppress(ray.exceptions.RayActorError):
                infos = await asyncio.gather(*(handle.about.remote() for handle in handles))
                return [Found(n, info.pid, handles[n]) for n, info in enumerate(infos)]
            await asyncio.sleep(0.1)


async def until_answered(case: EngineCase, request: Advance) -> Reply:
    refused: Unavailable | None = None
    try:
        async with asyncio.timeout(300):
            while True:
                try:
                    return await case.engine.advance(request)
                except Unavailable as error:
                    refused = error
                await asyncio.sleep(0.1)
    except TimeoutError as late:
        raise TimeoutError(f"no answer in 300 s; the last refusal: {refused}") from late


async def replayed(case: EngineCase, requests: list[Advance]) -> None:
    """Send the last request; where the session is behind, the ones before it again, as a client does."""
    try:
        await until_answered(case, requests[-1])
    except SeqConflict as conflict:
        for request in requests[conflict.expected - 1 :]:
            await until_answered(case, request)


def step_of(reply: Reply) -> tuple[object, ...]:
    assert isinstance(reply.outcome, tuple)
    [step] = reply.outcome
    return reply.seq, step.observation.tobytes(), step.reward.tobytes(), step.terminated.tobytes()


@pytest.fixture(scope="module")
def fronts(
    database: str, address: str, engine: SessionEngine, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[list[str]]:
    """Addresses of two front servers."""
    options = ("--database", database, "--engine", "ray", "--ray-address", address)
    folders = [tmp_path_factory.mktemp(name) for name in ("first", "second")]
    with running_server(folders[0], *options, **PACE) as first, running_server(folders[1], *options, **PACE) as second:
        yield [first.url, second.url]


@pytest.mark.parametrize("number", [0, 1])
def test_the_conformance_suite_passes_at_each_front_server(fronts: list[str], number: int):
    outcomes = {outcome.name: outcome.failure for outcome in conformance(fronts[number], None, f"front-{number}")}
    assert len(outcomes) == len(checks.WITHOUT_MODEL) + len(checks.WITH_MODEL)
    assert set(outcomes.values()) == {None}, outcomes


def test_the_conformance_suite_passes_while_sessions_alternate_between_two_front_servers(
    fronts: list[str], capsys: pytest.CaptureFixture[str]
):
    with alternating(fronts) as alternation:
        outcomes = {outcome.name: outcome.failure for outcome in conformance(fronts[0], None, "alternating")}
    assert len(outcomes) == len(checks.WITHOUT_MODEL) + len(checks.WITH_MODEL)
    assert set(outcomes.values()) == {None}, outcomes
    shared = alternation.by_session()
    assert len(shared) > len(checks.WITH_MODEL)
    for session, (first, second) in shared.items():
        assert first - second in (0, 1), (session, shared)
    counts = " and ".join(str(sum(of_server)) for of_server in zip(*shared.values(), strict=True))
    with capsys.disabled():
        print(f"\n{len(outcomes)} checks hold; {len(shared)} sessions, {counts} requests at the front servers")


def test_a_session_can_continue_through_any_front_server(fronts: list[str]):
    action = np.full((2, 1), 0.5)
    with HttpSurrogate(fronts[0], NAME, transport="stream") as port:
        alone = port.open(OpenSession(num_envs=2, seed=0)).id
        port.reset(alone)
        expected = [port.step(alone, action).observation for _ in range(6)]
        shared = port.open(OpenSession(num_envs=2, seed=0)).id
        port.reset(shared)
        found = [port.step(shared, action).observation for _ in range(2)]
    clients = [httpx.Client(base_url=url, timeout=60) for url in fronts]
    for turn in range(4):
        body = {"seq": turn + 4, "action": action.tolist()}
        replies = [client.post(f"/v1/sessions/{shared}/step", json=body).raise_for_status() for client in clients]
        assert replies[0].content == replies[1].content, "the second server repeats what the first one did"
        found.append(np.array(replies[0].json()["observation"], dtype=np.float32))
    np.testing.assert_array_equal(found, expected)
    listed = [client.get(f"/v1/surrogates/{NAME}").json()["sessions"] for client in clients]
    assert listed[0] == listed[1] >= 2
    for client in clients:
        client.close()


@pytest.fixture
def server(database: str, address: str, engine: SessionEngine, tmp_path: Path) -> Iterator[ServerProcess]:
    """A front server."""
    options = ("--database", database, "--engine", "ray", "--ray-address", address)
    with running_server(tmp_path, *options, **PACE) as running:
        yield running


@pytest.mark.parametrize("transport", ["stream", "binary"])
def test_a_client_gets_bit_equal_replies_while_session_hosts_are_killed(
    server: ServerProcess, database: str, storage: Storage, transport: Transport
):
    """The client sends its last requests again by itself."""

    def kill_its_host(session: str) -> None:
        holder = storage.part(LiveSessions).holder(session)
        assert holder is not None
        owner = int(holder.owner.partition(" ")[0])
        [host] = [one for one in asyncio.run(about(database)) if one.number == owner]
        os.kill(host.pid, signal.SIGKILL)

    with HttpSurrogate(server.url, NAME, transport=transport) as port:
        undisturbed = walked(port, {})
        np.testing.assert_array_equal(walked(port, {120: kill_its_host, 250: kill_its_host}), undisturbed)


def test_the_design_of_a_front_server_runs_its_fits_in_the_ray_cluster(server: ServerProcess):
    with httpx.Client(base_url=server.url, timeout=60) as client:
        assert pendulum.teach(client, "taught")["model_version"] >= 1
    assert "fits run as tasks of the cluster" in server.log


def test_a_client_gets_bit_equal_replies_while_postgresql_crashes(server: ServerProcess, postgresql: Postgresql):
    """Steps go on until the lease ends, and again when the database is back."""

    def away_for_longer_than_a_lease(_: str) -> None:
        postgresql.stop()
        time.sleep(2 * LEASE)
        threading.Timer(1.0, postgresql.start).start()

    with HttpSurrogate(server.url, NAME) as port:
        undisturbed = walked(port, {})
        found = walked(port, {120: lambda _: postgresql.stop(), 140: lambda _: postgresql.start()})
        np.testing.assert_array_equal(found, undisturbed)
        np.testing.assert_array_equal(walked(port, {200: away_for_longer_than_a_lease}), undisturbed)


def walked(port: HttpSurrogate, disturbances: dict[int, Callable[[str], None]]) -> list[Any]:
    """Observations of a new session's steps, with what happens before some of them."""
    actions = np.random.default_rng(0).uniform(-2, 2, (400, 2, 1))
    session = port.open(OpenSession(num_envs=2, seed=0)).id
    observations = [port.reset(session).observation]
    for number, action in enumerate(actions):
        if happens := disturbances.get(number):
            happens(session)
        observations.append(port.step(session, action).observation)
    port.close(session)
    return observations


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"database": "surrogym.db"}, "expected a PostgreSQL database, which all machines reach, got a SQLite file"),
        ({"ray_address": "127.0.0.1:9"}, "expected a Ray cluster at '127.0.0.1:9', got none"),
        ({"ray_address": "ray://there:10001"}, "expected the address of a Ray cluster, auto or host:port"),
        ({"ray_hosts": HOSTS + 1}, "which have hosts 2, got 3"),
        ({"max_lanes": 5}, "which have max_lanes"),
    ],
)
def test_an_unsuitable_ray_cluster_is_refused_in_one_sentence(
    settings: Settings, engine: SessionEngine, storage: Storage, options: dict[str, object], said: str
):
    with pytest.raises(InvalidInput, match=said) as refused:
        pool.connect(Settings.model_validate(settings.model_dump() | options), storage)
    assert "\n" not in str(refused.value)


def test_session_hosts_that_wait_for_cluster_resources_are_logged_with_the_reason(
    settings: Settings,
    storage: Storage,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    """A host that waits for a GPU, which the cluster lacks, stands for one that waits for a CPU."""
    monkeypatch.setattr(pool, "QUIET_SECONDS", 0.5)
    monkeypatch.setattr(pool, "STARTING_SECONDS", 1.0)
    database = f"{settings.database}//"
    try:
        with pytest.raises(Unavailable, match="each takes one of the cluster's CPUs and one of its GPUs"):
            pool.connect(settings.model_copy(update={"database": database, "device": "cuda"}), storage)
    finally:
        ray.kill(ray.get_actor(f"session host 0 of {pool.pool_name(database)}"))
    assert "waiting for 1 session hosts to start, for 1 s at most" in caplog.text
    assert f"of {HOSTS + 1} CPUs and 0 of 0 GPUs" in caplog.text


def test_a_front_server_with_other_versions_than_the_session_hosts_is_refused(
    settings: Settings, engine: SessionEngine, storage: Storage, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pool, "versions", lambda: {"Python": "2.7"})
    with pytest.raises(InvalidInput, match=r"expected Python 3\..*, which the session hosts run, got Python 2\.7"):
        pool.connect(settings, storage)
