"""A lease is checked before each real step, by a clock that counts while the machine sleeps."""

from __future__ import annotations

import time

import pytest

from surrogym_client.errors import LeaseExpired, ServerUnreachable
from surrogym_sampler.queries.leases import LeaseEnded, Leases, seconds_awake_or_asleep
from surrogym_shared.codes import Code, Problem
from surrogym_shared.wire import StepQuery

LEASE = 60.0
QUERY = StepQuery(
    id=1,
    number=0,
    purpose="initial",
    attempt=1,
    lease_token="token",
    lease_seconds=LEASE,
    coordinates=[0.0],
    action=[0.0],
)
ENDED = LeaseExpired(Problem(title="ended", status=409, code=Code.LEASE_EXPIRED, detail="the lease has ended"))


class Renewing:
    """A server that renews, or raises what it is told to."""

    def __init__(self):
        self.error: Exception | None = None
        self.asked = 0

    def renew(self, *_, **__):
        self.asked += 1
        if self.error is not None:
            raise self.error


class Clock:
    now = 1_000.0

    def __call__(self):
        return self.now


@pytest.fixture
def server():
    return Renewing()


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def leases(server, clock):
    """Holds the query since now; nothing beats, as in a machine that sleeps."""
    leases = Leases(server, "line", LEASE, clock)
    leases.hold([QUERY], since=clock())
    return leases


def test_a_step_under_a_fresh_lease_sends_no_renewal_request(leases, server, clock):
    clock.now += 0.8 * LEASE
    leases.check(QUERY)
    assert server.asked == 0


def test_a_nearly_expired_lease_is_renewed_before_the_step(leases, server, clock):
    clock.now += 0.95 * LEASE
    leases.check(QUERY)
    clock.now += 0.8 * LEASE
    leases.check(QUERY)
    assert server.asked == 1


def test_no_real_step_is_taken_under_an_expired_lease(leases, server, clock):
    clock.now += 2 * LEASE
    server.error = ENDED
    for _ in range(2):
        with pytest.raises(LeaseEnded, match="another sampler may have answered it"):
            leases.check(QUERY)
    assert server.asked == 1


def test_with_an_unreachable_server_steps_are_taken_only_until_the_lease_expires(leases, server, clock):
    server.error = ServerUnreachable("nobody answers")
    clock.now += 0.95 * LEASE
    leases.check(QUERY)
    clock.now += 0.1 * LEASE
    with pytest.raises(LeaseEnded):
        leases.check(QUERY)
    server.error = None
    leases.check(QUERY)


def test_no_real_step_is_taken_for_a_query_without_lease(leases):
    leases.release(QUERY)
    with pytest.raises(LeaseEnded):
        leases.check(QUERY)


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no clock that counts its sleep")
def test_the_lease_clock_includes_the_time_the_computer_sleeps(monkeypatch):
    monkeypatch.setattr(time, "clock_gettime", {time.CLOCK_BOOTTIME: 7.0}.__getitem__)
    assert seconds_awake_or_asleep() == 7.0
