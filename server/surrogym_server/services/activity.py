"""Samplers, and others who call regularly, that are active. Shown to people, and kept in memory."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Generic, TypeVar

Clock = Callable[[], float]
T = TypeVar("T")

ALIVE_SECONDS = 75.0  # one that was silent for longer counts as gone; the longest claim waits for 60
FORGET_AT = 256  # entries, those of the silent included; a search through all at each call would take longer with each


class Alive(Generic[T]):
    """When each was last heard of, and what it reported about itself. Any thread may call it."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._heard: dict[tuple[str, str], tuple[float, T]] = {}
        self._forget_at = FORGET_AT
        self._lock = threading.Lock()

    def note(self, surrogate: str, name: str, said: T) -> bool:
        """Note a call. Returns whether the caller is new, or was silent for so long that it counted as gone."""
        now, key = self._clock(), (surrogate, name)
        with self._lock:
            before, _ = self._heard.get(key, (-ALIVE_SECONDS, said))
            self._heard[key] = (now, said)
            if len(self._heard) > self._forget_at:
                self._heard = {key: one for key, one in self._heard.items() if now - one[0] < ALIVE_SECONDS}
                self._forget_at = max(FORGET_AT, 2 * len(self._heard))
        return now - before >= ALIVE_SECONDS

    def alive(self) -> list[tuple[str, str, T]]:
        """The surrogate, the name and the report of each."""
        now = self._clock()
        with self._lock:
            heard = sorted(self._heard.items(), key=lambda one: one[0])
        return [(*key, said) for key, (at, said) in heard if now - at < ALIVE_SECONDS]


class Samplers(Alive[None]):
    """When each sampler was last heard of."""

    def heard(self, surrogate: str, sampler: str) -> None:
        self.note(surrogate, sampler, None)

    def by_surrogate(self) -> dict[str, list[str]]:
        """Names of the samplers that claimed or answered lately."""
        alive = defaultdict[str, list[str]](list)
        for surrogate, sampler, _ in self.alive():
            alive[surrogate].append(sampler)
        return alive
