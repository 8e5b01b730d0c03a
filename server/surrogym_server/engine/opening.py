"""Sessions of one surrogate are opened one after the other, so that a repeat finds the session of its key."""

from __future__ import annotations

import asyncio
from weakref import WeakValueDictionary


class OpeningLocks:
    """A lock for each surrogate. A large model takes long to load and to draw functions from, and openings of other
    surrogates don't wait for it."""

    def __init__(self) -> None:
        self._locks = WeakValueDictionary[int, asyncio.Lock]()

    def of(self, surrogate: int) -> asyncio.Lock:
        """The lock of a surrogate, by its id. It exists as long as somebody holds it or waits for it."""
        return self._locks.setdefault(surrogate, asyncio.Lock())
