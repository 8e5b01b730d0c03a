"""A PPO training in a real Ray cluster meets kills of session hosts and of its front server, and nothing changes."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import sqlalchemy as sa
from numpy.typing import NDArray

from support.chaos import SEED, times
from support.disturbed import PATIENT, disturbed_training, require_same_policy
from support.postgresql import running_postgresql
from support.ray_cluster import RayCluster
from support.server import RestartingServer
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import OpenSession
from surrogym_trainer.training import TrainResult

ray = pytest.importorskip("ray")

from surrogym_server.features.ray import pool  # noqa: E402

FAULTS, HOSTS, PATIENCE = times(short=1, full=20), 2, 120.0
ENVIRONMENT = {"SURROGYM_RAY_LEASE_SECONDS": "3"}

pytestmark = [
    pytest.mark.postgresql,
    pytest.mark.timeout(3_600),
    pytest.mark.filterwarnings("ignore::FutureWarning:ray"),
]


@pytest.fixture(scope="module")
def database() -> Iterator[str]:
    with running_postgresql() as postgresql:
        yield postgresql.new_database()


@pytest.fixture(scope="module")
def server(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RestartingServer]:
    """A front server of a cluster that this process begins."""
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    begun = ray.init("local", num_cpus=HOSTS, namespace=pool.NAMESPACE, include_dashboard=False, log_to_driver=False)
    options = ("--database", database, "--engine", "ray", "--ray-address", str(begun.address_info["gcs_address"]))
    server = RestartingServer(tmp_path_factory.mktemp("cluster"), *options, **ENVIRONMENT)
    try:
        with Api(server.url) as api:
            teach(api, "pendulum", pendulum(), queries=12)
        yield server
    finally:
        server.stop()
        ray.shutdown()


@pytest.fixture(scope="module")
def calm(server: RestartingServer, tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    """The undisturbed training."""
    return disturbed_training(server.url, tmp_path_factory.mktemp("calm") / "calm.zip", FAULTS)


def test_a_training_learns_the_same_policy_although_session_hosts_are_killed(
    server: RestartingServer, database: str, calm: TrainResult, tmp_path: Path
):
    source, engine = random.Random(SEED), sa.create_engine(database.replace("postgresql:", "postgresql+psycopg:"))

    def strike() -> None:
        with engine.connect() as connection:
            owners = connection.exec_driver_sql("SELECT owner FROM live_sessions ORDER BY id").scalars().all()
        number = int(source.choice(owners).partition(" ")[0])
        os.kill(pid_of(database, number), signal.SIGKILL)

    try:
        require_same_policy(disturbed_training(server.url, tmp_path / "killed.zip", FAULTS, strike), calm)
    finally:
        engine.dispose()


def test_a_training_learns_the_same_policy_although_the_front_server_is_killed(
    server: RestartingServer, calm: TrainResult, tmp_path: Path
):
    def strike() -> None:
        server.stop(signal.SIGKILL)
        server.start()

    require_same_policy(disturbed_training(server.url, tmp_path / "killed.zip", FAULTS, strike), calm)


def test_sessions_continue_after_the_whole_ray_cluster_was_killed_and_restarted(tmp_path: Path):
    """With its front server, which ends or is started again when its cluster is gone. PostgreSQL has the sessions."""
    actions = np.random.default_rng(SEED).uniform(-2, 2, (200, 2, 1))
    with running_postgresql() as postgresql, TemporaryDirectory(prefix="ray") as folder:
        cluster = RayCluster(Path(folder), HOSTS)
        cluster.start()
        try:
            options = ("--database", postgresql.new_database(), "--engine", "ray", "--ray-address", cluster.address)
            server = RestartingServer(tmp_path, *options, **ENVIRONMENT)
            try:
                with Api(server.url) as api:
                    teach(api, "pendulum", pendulum(), queries=12)

                def strike() -> None:
                    cluster.kill()
                    server.stop(signal.SIGKILL)
                    cluster.start()
                    server.start()

                with HttpSurrogate(server.url, "pendulum", retries=PATIENT) as port:
                    undisturbed = walked(port, actions)
                    np.testing.assert_array_equal(walked(port, actions, strike), undisturbed)
            finally:
                server.stop()
        finally:
            cluster.kill()


def walked(
    port: HttpSurrogate, actions: NDArray[np.float64], strike: Callable[[], None] | None = None
) -> NDArray[np.float32]:
    """Observations of a new session's steps, (T + 1, N, D); something strikes before the middle one."""
    session = port.open(OpenSession(num_envs=actions.shape[1], seed=SEED)).id
    observations = [port.reset(session).observation]
    for number, action in enumerate(actions):
        if strike is not None and number == len(actions) // 2:
            strike()
        observations.append(port.step(session, action).observation)
    port.close(session)
    return np.array(observations)


def pid_of(database: str, number: int) -> int:
    """Of a session host, once it runs."""
    host = ray.get_actor(f"session host {number} of {pool.pool_name(database)}")
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        with suppress(ray.exceptions.RayActorError):
            return int(ray.get(host.about.remote(), timeout=PATIENCE).pid)
        time.sleep(0.1)
    raise AssertionError(f"session host {number} did not come back")
