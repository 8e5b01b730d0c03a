"""Clients that called the server recently, such as samplers. They are kept in memory, and shown in the dashboard."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Generic, TypeVar

Clock = Callable[[], float]
T = TypeVar("T")

ALIVE_SECONDS = 75.0  # a client counts as inactive if its last call began longer ago; a long poll lasts up to 60 s
FORGET_AT = 256  # inactive clients are removed only when more clients are stored: a search at each call would be slow
MOST_NAMES = 1_000  # the dashboard shows at most this many active clients of a surrogate; the server serves all


class Alive(Generic[T]):
    """Record of the clients that call the server for a surrogate: the time of each client's last call, and the status
    (``T``) that the client reported in it. Thread-safe."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        # Time of the last call and reported status, by names of the surrogate and of the client.
        self._heard = defaultdict[str, dict[str, tuple[float, T]]](dict)
        self._forget_at = FORGET_AT
        self._lock = threading.Lock()

    def note(self, surrogate: str, name: str, status: T) -> bool:
        """Record a call of the client ``name``. Return whether the client is new or was inactive before the call.

        A new client is not recorded while ``MOST_NAMES`` others of the surrogate are active; the result is then False.
        """
        now = self._clock()
        with self._lock:
            names = self._heard[surrogate]
            if name not in names and len(names) >= MOST_NAMES:
                names = self._heard[surrogate] = self._active(names, now)
                if len(names) >= MOST_NAMES:
                    return False
            before, _ = names.get(name, (-ALIVE_SECONDS, status))
            new = name not in names
            names[name] = (now, status)
            if new:
                self._forget_silent(now)
        return now - before >= ALIVE_SECONDS

    def forget(self, surrogate: str, name: str) -> None:
        """Remove a client that ends."""
        with self._lock:
            self._heard[surrogate].pop(name, None)

    def alive(self) -> list[tuple[str, str, T]]:
        """Return (surrogate, name, status) of each active client, sorted by surrogate and name."""
        now = self._clock()
        with self._lock:
            heard = {surrogate: self._active(names, now) for surrogate, names in self._heard.items()}
        return [
            (surrogate, name, heard[surrogate][name][1])
            for surrogate in sorted(heard)
            for name in sorted(heard[surrogate])
        ]

    def _forget_silent(self, now: float) -> None:
        if sum(map(len, self._heard.values())) > self._forget_at:
            active = {surrogate: self._active(names, now) for surrogate, names in self._heard.items()}
            self._heard = defaultdict(dict, {surrogate: names for surrogate, names in active.items() if names})
            self._forget_at = max(FORGET_AT, 2 * sum(map(len, self._heard.values())))

    @staticmethod
    def _active(names: dict[str, tuple[float, T]], now: float) -> dict[str, tuple[float, T]]:
        return {name: heard for name, heard in names.items() if now - heard[0] < ALIVE_SECONDS}


class Samplers(Alive[None]):
    """Record of the samplers that call the server, with the time of each sampler's last call, by surrogate."""

    def heard(self, surrogate: str, sampler: str) -> None:
        self.note(surrogate, sampler, None)

    def by_surrogate(self) -> dict[str, list[str]]:
        """Return the names of the active samplers, by surrogate."""
        alive = defaultdict[str, list[str]](list)
        for surrogate, sampler, _ in self.alive():
            alive[surrogate].append(sampler)
        return alive
