"""Connections that break in the middle of steps: the step happens once, and nobody can tell from the numbers."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest

from support.cutting_proxy import cutting_proxy
from support.server import ServerProcess
from surrogym_client.connection import Retries
from surrogym_client.transport import HttpSurrogate, Transport
from surrogym_shared.wire import OpenSession

LANES, STEPS, PLANNED = 3, 150, 8
QUICK = Retries(seconds=60, first_delay=0.001, longest_delay=0.01)
SESSION = OpenSession(num_envs=LANES, seed=3, time_limit=7)


def trajectory(port: HttpSurrogate) -> list[np.ndarray]:
    """Everything that a trainer sees in so many steps, and a rollout at the end."""
    session = port.open(SESSION).id
    actions = np.random.default_rng(1).uniform(-2, 2, (STEPS, LANES, 1)).astype(np.float32)
    seen = [port.reset(session).observation]
    for action in actions:
        result = port.step(session, action)
        seen += [result.observation, result.reward, result.truncated]
    for result in port.rollout(session, actions[:PLANNED]):
        seen += [result.observation, result.reward, result.truncated]
    port.close(session)
    return seen


def short_lives(seed: int, longest: int = 1_500) -> Iterator[int]:
    """Bytes until a connection is cut: often within the first reply, or before it."""
    source = random.Random(seed)
    while True:
        yield source.randint(0, longest) if source.random() < 0.8 else 6_000


@pytest.mark.parametrize("transport", ["auto", "stream", "binary", "json"])
def test_cut_connections_change_no_number(pendulum_server: ServerProcess, transport: Transport):
    with HttpSurrogate(pendulum_server.url, "pendulum", transport="json") as port:
        expected = trajectory(port)
    with (
        cutting_proxy(pendulum_server.url, short_lives(seed=0)) as proxy,
        HttpSurrogate(proxy.url, "pendulum", retries=QUICK, transport=transport) as port,
    ):
        found = trajectory(port)
        assert proxy.cuts > 3, "the proxy did its worst"
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
