"""The sweeper: ends the leases and the sessions whose time has come, and sees what other servers have stored."""

from __future__ import annotations

import asyncio
import logging
import time

from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.sessions import LiveSessions
from surrogym_server.errors import SurrogymError
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.storage.port import Storage

logger = logging.getLogger(__name__)

ORPHAN_SECONDS = 3_600.0  # before files that nothing leads to are removed; an upload takes less


class Sweeper:
    def __init__(
        self, storage: Storage, live: LiveSessions, models: ModelCache, seconds: float, metrics: ProcessMetrics
    ) -> None:
        self._storage = storage
        self._live = live
        self._models = models
        self._seconds = seconds
        self._metrics = metrics
        self._looked_at_files = -ORPHAN_SECONDS

    async def run(self) -> None:
        """Sweep every so many seconds, for ever; ends by cancellation."""
        while True:
            await self.sweep()
            await asyncio.sleep(self._seconds)

    async def sweep(self) -> None:
        """Sweep once. A lease that ends here leaves its query to the next sampler, or sets it aside; a session whose
        surrogate another server has deleted ends."""
        for id in self._live.sweep():
            self._metrics.expired_sessions += 1
            logger.info("session %s was idle and has expired", id)
        try:
            await asyncio.to_thread(self._sweep_files)
            self._metrics.expired_leases += await asyncio.to_thread(self._storage.queries.sweep_expired)
            for surrogate in await asyncio.to_thread(self._models.look):
                self._live.close_all_of(surrogate)
        except SurrogymError as error:
            logger.warning("a sweep was cut short, the next one follows: %s", error)
        except Exception:  # leases must go on to end, whatever one sweep meets
            logger.exception("a sweep failed; the next one follows")

    def _sweep_files(self) -> None:
        """Once in ``ORPHAN_SECONDS``, remove the files whose policy or surrogate was deleted, or never stored."""
        now = time.monotonic()
        if now - self._looked_at_files < ORPHAN_SECONDS:
            return
        self._looked_at_files = now
        old = self._storage.blobs.older(ORPHAN_SECONDS)
        orphans = tuple(sorted(old - self._storage.policies.blobs())) if old else ()
        self._storage.blobs.remove(orphans)
        if orphans:
            logger.info("files of policies that are gone were removed: %d", len(orphans))
