"""Sessions in a real Ray cluster of this machine, over a real PostgreSQL: the laws, and two front servers."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from support.postgresql import running_postgresql
from support.server import running_server
from surrogym_client.original import classic
from surrogym_client.transport import HttpSurrogate
from surrogym_server.cluster import pool
from surrogym_server.convert import stored_definition
from surrogym_server.engine.design_job import DesignJob, run_design_job
from surrogym_server.engine.port import SessionEngine
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput, Unavailable, UnknownSession
from surrogym_server.settings import Settings
from surrogym_server.storage.records import NewModel, NewSurrogate
from surrogym_server.storage.sql import open_storage
from surrogym_server.testing import LAWS_OF_ENGINES, EngineCase
from surrogym_shared.wire import OpenSession

ray = pytest.importorskip("ray")

NAME, HOSTS = "pendulum", 2

pytestmark = [pytest.mark.postgresql, pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


@pytest.fixture(scope="module")
def database(pendulum_samples: Samples) -> Iterator[str]:
    """A PostgreSQL with one surrogate that has a model."""
    spec, samples = classic.pendulum(), pendulum_samples
    arrays = (samples.q, samples.u, samples.q_next, samples.reward, samples.terminated)
    job = DesignJob(stored_definition(spec), *(a.numpy() for a in arrays), state={}, budget=len(samples), target=0.999)
    done = run_design_job(job)
    with running_postgresql() as postgresql:
        url = postgresql.new_database()
        storage = open_storage(url)
        storage.surrogates.create(NewSurrogate(NAME, spec.model_dump(mode="json"), len(samples), 0.999))
        model = NewModel(len(samples), done.data_hash, done.fidelity, done.description, 0.0, done.model)
        storage.models.add(NAME, model)
        storage.close()
        yield url


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a Ray cluster that this process begins."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    begun = ray.init(num_cpus=HOSTS, namespace=pool.NAMESPACE, include_dashboard=False, log_to_driver=False)
    yield str(begun.address_info["gcs_address"])
    ray.shutdown()


@pytest.fixture(scope="module")
def engine(database: str, address: str) -> SessionEngine:
    return pool.connect(Settings(database=database, engine="ray", ray_address=address, ray_hosts=HOSTS))


@pytest.mark.parametrize("law", LAWS_OF_ENGINES, ids=lambda law: law.__name__)
def test_the_engine_of_a_cluster_keeps_the_laws(law, engine: SessionEngine, database: str):
    storage = open_storage(database)
    surrogate = storage.surrogates.get(NAME).id
    storage.close()
    asyncio.run(law(EngineCase(engine, NAME, surrogate, stored_definition(classic.pendulum()))))


def test_sessions_of_a_host_that_died_are_unknown_and_new_ones_open(engine: SessionEngine, database: str):
    """Never silently: a step is refused, and the trainer ends its episodes and opens a new session."""
    storage = open_storage(database)
    case = EngineCase(engine, NAME, storage.surrogates.get(NAME).id, stored_definition(classic.pendulum()))
    storage.close()

    async def killed() -> None:
        lost = await case.opened(key="on one host")
        number = int(lost.rpartition(".")[2])
        ray.kill(ray.get_actor(f"session host {number} of {pool.pool_name(database)}"), no_restart=False)
        async with asyncio.timeout(300):
            while True:
                try:
                    await engine.advance(case.steps(lost)[0])
                except Unavailable:
                    await asyncio.sleep(0.1)
                except UnknownSession:
                    break
        again = await case.opened(key="on one host")
        assert again != lost
        assert again.rpartition(".")[2] == str(number)
        assert (await engine.advance(case.steps(again)[0])).seq == 2

    asyncio.run(killed())


@pytest.mark.long
def test_any_front_server_goes_on_with_a_session(database: str, address: str, engine: SessionEngine, tmp_path: Path):
    options = ("--database", database, "--engine", "ray", "--ray-address", address)
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
    with running_server(folders[0], *options) as first, running_server(folders[1], *options) as second:
        urls, action = (first.url, second.url), np.full((2, 1), 0.5)
        with HttpSurrogate(urls[0], NAME, transport="stream") as port:
            alone = port.open(OpenSession(num_envs=2, seed=0)).id
            port.reset(alone)
            expected = [port.step(alone, action).observation for _ in range(6)]
            shared = port.open(OpenSession(num_envs=2, seed=0)).id
            port.reset(shared)
            found = [port.step(shared, action).observation for _ in range(2)]
        clients = [httpx.Client(base_url=url, timeout=60) for url in urls]
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


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"database": "surrogym.db"}, "expected a PostgreSQL database, which all machines reach, got a SQLite file"),
        ({"ray_address": "127.0.0.1:9"}, "expected a cluster at '127.0.0.1:9', got none"),
        ({"ray_address": "ray://there:10001"}, "expected auto or host:port"),
        ({"ray_hosts": HOSTS + 1}, "which have hosts 2, got 3"),
        ({"max_lanes": 5}, "which have max_lanes"),
    ],
)
def test_what_can_not_serve_a_cluster_is_one_sentence(
    database: str, address: str, engine: SessionEngine, options: dict[str, object], said: str
):
    settings = Settings.model_validate({"database": database, "engine": "ray", "ray_address": address} | options)
    with pytest.raises(InvalidInput, match=said) as refused:
        pool.connect(settings)
    assert "\n" not in str(refused.value)


def test_other_versions_than_the_hosts_run_are_refused(
    database: str, address: str, engine: SessionEngine, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pool, "versions", lambda: {"Python": "2.7"})
    with pytest.raises(InvalidInput, match=r"expected Python 3\..*, which the session hosts run, got Python 2\.7"):
        pool.connect(Settings(database=database, engine="ray", ray_address=address, ray_hosts=HOSTS))


def test_without_ray_one_sentence_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pool, "find_spec", lambda _: None)
    with pytest.raises(InvalidInput, match=r"pip install 'surrogym\[ray\]'"):
        pool.check(Settings(database="postgresql+psycopg://here/there", engine="ray"))
