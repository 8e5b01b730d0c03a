"""The sweeper: periodic work that ends expired leases and sessions, finds changes of other servers and removes old
events."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

from surrogym_server.engine.port import SessionEngine
from surrogym_server.errors import SurrogymError
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.storage.sql import Storage

logger = logging.getLogger(__name__)

EVENTS_KEPT = 10_000  # of each surrogate, this many events are kept in the database, the newest ones
PRUNE_SECONDS = 60.0


class Sweeper:
    def __init__(
        self,
        storage: Storage,
        engine: SessionEngine,
        seconds: float,
        metrics: ProcessMetrics,
        notices: Notices,
        others: Sequence[Callable[[], Awaitable[None]]] = (),
    ) -> None:
        """Keep the objects of the server on which the periodic work is done.

        ``seconds`` is the time between two sweeps. ``others`` are functions of optional features that each sweep calls.
        """
        self._storage = storage
        self._engine = engine
        self._seconds = seconds
        self._metrics = metrics
        self._notices = notices
        self._others = others
        self._pruned = -PRUNE_SECONDS

    async def run(self) -> None:
        """Sweep every ``seconds`` until cancelled."""
        while True:
            await self.sweep()
            await asyncio.sleep(self._seconds)

    async def sweep(self) -> None:
        """Do the periodic work once.

        Queries of expired leases become open again, or are set aside (not leased again) after repeated failures.
        Expired sessions end, and so do sessions whose surrogate another server has deleted. Requests that wait for a
        changed surrogate are woken. Old events are removed.
        """
        await self._try(self._engine.sweep)
        for sweep in (self._sweep_leases, *self._others):
            await self._try(sweep)
        await self._try(self._find_changes)
        await self._try(partial(asyncio.to_thread, self._prune))

    async def _sweep_leases(self) -> None:
        self._metrics.expired_leases += await asyncio.to_thread(self._storage.queries.sweep_expired)

    async def _find_changes(self) -> None:
        """Wake the requests that wait for a surrogate that has changed, in case the notice of the change was lost."""
        if names := self._notices.listened:
            self._notices.compare(await asyncio.to_thread(self._storage.events.newest, names))

    async def _try(self, sweep: Callable[[], Awaitable[None]]) -> None:
        try:
            await sweep()
        except SurrogymError as error:
            logger.warning("a sweep stopped early; it is repeated shortly: %s", error)
        except Exception:  # any error is logged, so that later sweeps take place
            logger.exception("a sweep failed; it is repeated shortly")

    def _prune(self) -> None:
        """Remove old events, so that each surrogate keeps the newest ``EVENTS_KEPT``, and finish deletions of
        surrogates that a crash interrupted. Do nothing if the last time was less than ``PRUNE_SECONDS`` ago."""
        now = time.monotonic()
        if now - self._pruned < PRUNE_SECONDS:
            return
        self._pruned = now
        if completed := self._storage.surrogates.complete_removals():
            logger.info("surrogates whose removal was interrupted: %d", completed)
        if removed := self._storage.events.prune(EVENTS_KEPT):
            logger.info("old events removed: %d", removed)
