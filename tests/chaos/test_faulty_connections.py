"""Replies that are dropped, late, cut, or answer a request sent twice: each step happens once, and nobody can tell
from the numbers."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest

from support.chaos import SEED, times
from support.cutting_proxy import cutting_proxy
from support.fault_proxy import fault_proxy
from support.server import ServerProcess
from support.walks import trajectory
from surrogym_client.transport import HttpSurrogate, Retries, Timeouts, Transport

STEPS = times(short=200, full=10_000)
QUICK = Retries(seconds=60, first_delay=0.001, longest_delay=0.01)
IMPATIENT = Timeouts(request=0.5, step=0.5, rollout=2.0, open=0.5)
DROPPED, DELAYED, DUPLICATED = 0.01, 0.05, 0.2
LONGEST_DELAY = 0.02

pytestmark = [pytest.mark.timeout(3_600), pytest.mark.parametrize("transport", ["auto", "stream", "binary", "json"])]


@pytest.fixture(scope="module")
def expected(pendulum_server: ServerProcess) -> list[np.ndarray]:
    """The trajectory without faults."""
    with HttpSurrogate(pendulum_server.url, "pendulum", transport="json") as port:
        return trajectory(port, STEPS)


def same(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def short_lives(seed: int, longest: int = 1_500) -> Iterator[int]:
    """Bytes until a connection is cut: often within the first reply, or before it."""
    source = random.Random(seed)
    while True:
        yield source.randint(0, longest) if source.random() < 0.8 else 6_000


def test_a_stepped_trajectory_is_unchanged_by_broken_connections(
    pendulum_server: ServerProcess, expected: list[np.ndarray], transport: Transport
):
    with (
        cutting_proxy(pendulum_server.url, short_lives(SEED)) as proxy,
        HttpSurrogate(proxy.url, "pendulum", retries=QUICK, transport=transport) as port,
    ):
        same(trajectory(port, STEPS), expected)
        assert proxy.cuts > 3, "the proxy did its worst"


def test_a_stepped_trajectory_is_unchanged_by_lost_replies(
    pendulum_server: ServerProcess, expected: list[np.ndarray], transport: Transport
):
    with (
        fault_proxy(pendulum_server.url, "drop", DROPPED) as proxy,
        HttpSurrogate(proxy.url, "pendulum", timeouts=IMPATIENT, retries=QUICK, transport=transport) as port,
    ):
        same(trajectory(port, STEPS), expected)
        assert proxy.count > 0, "the proxy did its worst"


def test_a_stepped_trajectory_is_unchanged_by_late_replies(
    pendulum_server: ServerProcess, expected: list[np.ndarray], transport: Transport
):
    with (
        fault_proxy(pendulum_server.url, "delay", DELAYED, LONGEST_DELAY) as proxy,
        HttpSurrogate(proxy.url, "pendulum", retries=QUICK, transport=transport) as port,
    ):
        same(trajectory(port, STEPS), expected)
        assert proxy.count > 3, "the proxy did its worst"


def test_a_stepped_trajectory_is_unchanged_by_duplicated_requests(
    pendulum_server: ServerProcess, expected: list[np.ndarray], transport: Transport
):
    """The stream's own messages are sent once by its protocol; what is sent twice are its requests over HTTP."""
    with (
        fault_proxy(pendulum_server.url, "duplicate", DUPLICATED) as proxy,
        HttpSurrogate(proxy.url, "pendulum", retries=QUICK, transport=transport) as port,
    ):
        same(trajectory(port, STEPS), expected)
        assert proxy.count > 3 or transport in ("auto", "stream"), "the proxy did its worst"
