"""What a trainer sees when its server goes away and comes back: nothing, or truncated episodes that say why."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

from support.server import RestartingServer
from support.teaching import teach
from surrogym_client.environments.env import LOST
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.transport import Api, HttpSurrogate, Retries
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import OpenSession

LANES = 3
POLL_SECONDS, ROLLOUT_SECONDS = 50.0, 1.5  # a stop ends the first, and has five seconds' patience with the second
PATIENT = Retries(seconds=120)


@pytest.fixture(scope="module")
def restarting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RestartingServer]:
    restarting = RestartingServer(tmp_path_factory.mktemp("restarting"))
    try:
        with Api(restarting.url) as api:
            teach(api, "pendulum", pendulum(), queries=12)
        yield restarting
    finally:
        restarting.stop()


def actions(steps: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-2, 2, (steps, LANES, 1)).astype(np.float32)


def vec_env(restarting: RestartingServer) -> SurrogateVecEnv:
    return SurrogateVecEnv(restarting.url, "pendulum", LANES, seed=0, time_limit=6, retries=PATIENT)


def long_rollout(port: HttpSurrogate, session: str) -> np.ndarray:
    """Actions of a rollout that takes long on this machine, as busy as it is now."""
    started, few = time.perf_counter(), 100
    port.rollout(session, actions(few))
    return actions(max(int(few * ROLLOUT_SECONDS / (time.perf_counter() - started)), few))


def await_rollout(url: str) -> None:
    """Wait until a session has a request at work."""
    deadline = time.monotonic() + 60
    with httpx.Client(base_url=url, timeout=60) as client:
        while "surrogym_session_requests 1.0" not in client.get("/metrics").text:
            assert time.monotonic() < deadline


def test_environments_continue_with_unchanged_steps_across_a_clean_server_restart(restarting: RestartingServer):
    touched, undisturbed = vec_env(restarting), vec_env(restarting)
    expected = [undisturbed.reset(), *(undisturbed.step(action) for action in actions(10))]
    undisturbed.close()
    seen = [touched.reset(), *(touched.step(action) for action in actions(10)[:4])]
    restarting.stop()
    restarting.start()
    seen += [touched.step(action) for action in actions(10)[4:]]
    np.testing.assert_array_equal(seen[0], expected[0])
    for ours, theirs in zip(seen[1:], expected[1:], strict=True):
        for our, their in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(our, their)
        assert not any(LOST in info for info in ours[3])
    touched.close()


def test_a_stopping_server_ends_waiting_requests_and_finishes_running_steps(restarting: RestartingServer):
    design = pendulum().design.model_copy(update={"initial": 2, "budget": 2})
    with (
        Api(restarting.url) as api,
        HttpSurrogate(restarting.url, "pendulum", transport="binary", retries=Retries(seconds=0)) as port,
        ThreadPoolExecutor(2) as pool,
    ):
        api.create_surrogate("leased", pendulum().model_copy(update={"design": design}))
        assert len(api.claim("leased", "first", max_queries=2, wait_seconds=5.0).queries) == 2
        session = port.open(OpenSession(num_envs=LANES, seed=0)).id
        port.reset(session)
        long = long_rollout(port, session)
        poll = pool.submit(api.claim, "leased", "second", max_queries=1, wait_seconds=POLL_SECONDS)
        rollout = pool.submit(port.rollout, session, long)
        await_rollout(restarting.url)  # both are under way
        stopping = time.monotonic()
        assert restarting.stop() == 0
        assert time.monotonic() - stopping < POLL_SECONDS
        assert poll.result(timeout=10).queries == []
        assert len(rollout.result(timeout=10)) == len(long)
    restarting.start()


def test_a_server_crash_truncates_the_episodes_and_stepping_continues(restarting: RestartingServer):
    envs = vec_env(restarting)
    envs.reset()
    last, *_ = envs.step(actions(1)[0])
    restarting.stop(signal.SIGKILL)
    with ThreadPoolExecutor(1) as pool:
        step = pool.submit(envs.step, actions(1)[0])
        restarting.start()
        observation, reward, done, infos = step.result(timeout=120)
    assert done.all()
    assert not reward.any()
    for lane, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert "open a new session" in info[LOST]
        np.testing.assert_array_equal(info["terminal_observation"], last[lane])
    following, _, done, infos = envs.step(actions(1)[0])
    assert not done.any()
    assert not any(LOST in info for info in infos)
    assert not np.array_equal(following, observation)
    envs.close()
