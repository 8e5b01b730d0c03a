"""The leases of the queries that a sampler holds: what is left of each, and their renewal."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from surrogym_client.errors import ServerUnreachable, SurrogymClientError, Unavailable
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries
from surrogym_shared.wire import Query

AWAY = (ServerUnreachable, Unavailable)
ONE_ATTEMPT = Retries(seconds=0)  # at a renewal, which the next one repeats
NEARLY_OVER = 0.1  # of a lease


class LeaseEnded(Exception):
    """No real step may be begun for a query: another sampler may have answered it."""


def seconds_awake_or_asleep() -> float:
    """A clock that nobody sets. Where the system has such a one, it counts the time for which it was suspended."""
    if not hasattr(time, "clock_gettime"):
        return time.monotonic()
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@dataclass
class _Held:
    query: Query
    ends: float  # by the clock here, and by the server's no earlier


class Leases:
    """What a worker holds. A thread of its own renews it at a third of the leases' length.

    Args:
        api: the server.
        surrogate: its name there.
        lease_seconds: length of every lease.
        clock: seconds.
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(timeout=5.0)

    def hold(self, queries: Sequence[Query], since: float) -> None:
        """Keep queries that were claimed no earlier than ``since``, by the clock."""
        with self._lock:
            self._held.update({query.id: _Held(query, since + self._lease_seconds) for query in queries})

    def release(self, query: Query) -> None:
        with self._lock:
            self._held.pop(query.id, None)

    def check(self, query: Query) -> None:
        """Call before each real step of a query; the server is asked only where the lease is over or nearly so.

        Raises:
            LeaseEnded: the lease is over, or the server that could say so is away.
        """
        if self._left(query) <= NEARLY_OVER * self._lease_seconds:
            self._renew(query)
        if self._left(query) <= 0:
            raise LeaseEnded("its lease has ended, so that another sampler may have answered it")

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
            return  # the next beat tries again
        except SurrogymClientError:
            self.release(query)  # a late answer is still a true observation, so the step under way is finished
