"""The leases of the queries that a sampler has claimed: their remaining time, and their renewal."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

from surrogym_client.errors import SurrogymClientError
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import AWAY, ONE_ATTEMPT
from surrogym_shared.wire import Query

NEARLY_OVER = 0.1  # a lease counts as nearly over if at most this share of it is left


class LeaseEnded(Exception):
    """A query's lease has ended, so no real step may begin: another sampler may have answered the query."""


def seconds_awake_or_asleep() -> float:
    """Return the seconds of a monotonic clock. On systems that offer it, the clock also counts the time in which the
    machine was suspended."""
    if not hasattr(time, "clock_gettime"):
        return time.monotonic()
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@dataclass
class _Held:
    """A query that the sampler has claimed, and the end of its lease."""

    query: Query
    ends: float  # end of the lease by the local clock; by the server's clock it ends no earlier


class Leases:
    """The leases of a sampler's queries. A thread renews them each time a third of their length has passed.

    Args:
        api: the connection to the server.
        surrogate: name of the surrogate.
        lease_seconds: length of every lease.
        clock: returns the time in seconds.
    """

    def __init__(
        self, api: Api, surrogate: str, lease_seconds: float, clock: Callable[[], float] = seconds_awake_or_asleep
    ) -> None:
        self.clock = clock
        self._api = api
        self._surrogate = surrogate
        self._lease_seconds = lease_seconds
        self._held: dict[int, _Held] = {}
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join(timeout=5.0)

    def hold(self, queries: Sequence[Query], since: float) -> None:
        """Add the leases of claimed queries. Each lease is taken to begin at ``since``, the time before the claim."""
        with self._lock:
            self._held.update({query.id: _Held(query, since + self._lease_seconds) for query in queries})

    def release(self, query: Query) -> None:
        with self._lock:
            self._held.pop(query.id, None)

    def check(self, query: Query) -> None:
        """Check a query's lease before each of its real steps. The server is contacted only if the lease is over or
        nearly over.

        Raises:
            LeaseEnded: the lease is over, or the server could not confirm it.
        """
        if self._left(query) <= NEARLY_OVER * self._lease_seconds:
            self._renew(query)
        if self._left(query) <= 0:
            raise LeaseEnded(
                "the query's lease has ended, so another sampler may have answered it; no further step is taken"
            )

    def _left(self, query: Query) -> float:
        with self._lock:
            held = self._held.get(query.id)
        return 0.0 if held is None else held.ends - self.clock()

    def _beat(self) -> None:
        while not self._ending.wait(self._lease_seconds / 3):
            with self._lock:
                held = list(self._held.values())
            for one in held:
                self._renew(one.query)

    def _renew(self, query: Query) -> None:
        with self._lock:
            held = self._held.get(query.id)
        if held is None:
            return
        asked, seconds = self.clock(), self._lease_seconds
        try:
            self._api.renew(self._surrogate, query.id, query.lease_token, lease_seconds=seconds, retries=ONE_ATTEMPT)
            held.ends = asked + seconds
        except AWAY:
            return  # the server did not answer; the next renewal tries again
        except SurrogymClientError:
            self.release(query)  # The running step continues, because a late sample is still a true observation.
