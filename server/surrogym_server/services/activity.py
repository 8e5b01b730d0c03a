"""Samplers and trainer workers that are active, shown to people. Kept in memory."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

Clock = Callable[[], float]
T = TypeVar("T")

ALIVE_SECONDS = 75.0  # one that was silent for longer counts as gone; the longest claim waits for 60
FORGET_AT = 256  # entries, those of the silent included; a search through all at each call would take longer with each


class _Alive(Generic[T]):
    """When each was last heard of, and what it reported about itself. Any thread may call it."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._heard: dict[tuple[str, str], tuple[float, T]] = {}
        self._forget_at = FORGET_AT
        self._lock = threading.Lock()

    def _note(self, surrogate: str, name: str, said: T) -> bool:
        """Returns whether it is new, or was silent for so long that it counted as gone."""
        now, key = self._clock(), (surrogate, name)
        with self._lock:
            before, _ = self._heard.get(key, (-ALIVE_SECONDS, said))
            self._heard[key] = (now, said)
            if len(self._heard) > self._forget_at:
                self._heard = {key: one for key, one in self._heard.items() if now - one[0] < ALIVE_SECONDS}
                self._forget_at = max(FORGET_AT, 2 * len(self._heard))
        return now - before >= ALIVE_SECONDS

    def _alive(self) -> list[tuple[str, str, T]]:
        now = self._clock()
        with self._lock:
            heard = sorted(self._heard.items(), key=lambda one: one[0])
        return [(*key, said) for key, (at, said) in heard if now - at < ALIVE_SECONDS]


class Samplers(_Alive[None]):
    """When each sampler was last heard of."""

    def heard(self, surrogate: str, sampler: str) -> None:
        self._note(surrogate, sampler, None)

    def by_surrogate(self) -> dict[str, list[str]]:
        """Names of the samplers that claimed or answered lately."""
        alive = defaultdict[str, list[str]](list)
        for surrogate, sampler, _ in self._alive():
            alive[surrogate].append(sampler)
        return alive


class Offer(NamedTuple):
    """The largest number of real episodes that a trainer worker takes, and whether it has a reference controller."""

    most_episodes: int = 0
    reference: bool = False


class Workers(_Alive[Offer]):
    """When each trainer worker was last heard of, and its offer."""

    def heard(self, surrogate: str, worker: str, offer: Offer | None = None) -> bool:
        """Note that a worker claimed or reported, and return whether it is new. None keeps its earlier offer."""
        if offer is None:
            _, offer = self._heard.get((surrogate, worker), (0.0, Offer()))
        return self._note(surrogate, worker, offer)

    def of(self, surrogate: str) -> dict[str, Offer]:
        """The offer of each worker heard of lately, by its name."""
        return {worker: offer for owner, worker, offer in self._alive() if owner == surrogate}
