"""Which samplers are at work, for people to look at. Kept in memory."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable

Clock = Callable[[], float]

ALIVE_SECONDS = 60.0  # a sampler that was not heard of for so long is taken for gone


class Samplers:
    """When each sampler was last heard of. May be called from any thread."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._heard: dict[tuple[str, str], float] = {}

    def heard(self, surrogate: str, sampler: str) -> None:
        now = self._clock()
        fresh = {key: at for key, at in self._heard.copy().items() if now - at < ALIVE_SECONDS}
        self._heard = fresh | {(surrogate, sampler): now}

    def by_surrogate(self) -> dict[str, list[str]]:
        """Names of those that asked or answered within the last minute."""
        now, alive = self._clock(), defaultdict[str, list[str]](list)
        for (surrogate, sampler), at in sorted(self._heard.items()):
            if now - at < ALIVE_SECONDS:
                alive[surrogate].append(sampler)
        return alive
