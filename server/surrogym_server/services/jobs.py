"""Jobs of trainer workers: queued by people, claimed with a long poll, reported on, and ended."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable

from surrogym_server.services.activity import Workers
from surrogym_server.services.notices import Notices
from surrogym_server.services.queries import POLL_SECONDS
from surrogym_server.storage.jobs import JobProgress, JobRecord, JobResult, LeasedJob, NewJob
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import JSON


class JobService:
    def __init__(self, storage: Storage, notices: Notices, workers: Workers | None = None) -> None:
        self._storage = storage
        self._notices = notices
        self._workers = workers or Workers()

    def train(self, name: str, task: JSON, key: str | None) -> JobRecord:
        """Queue a training.

        Raises:
            NoModel: nothing has been fitted yet.
            Overloaded: too many jobs wait.
        """
        self._storage.models.get(name)
        return self._add(name, NewJob("train", task), key)

    def evaluate(self, name: str, task: JSON, episodes: int, key: str | None) -> JobRecord:
        """Queue an evaluation of so many real episodes. The task then names the version of its policy.

        Raises:
            UnknownPolicy: no such policy.
            Overloaded: too many jobs wait.
        """
        version = self._storage.policies.get(name, task["policy"]).version
        return self._add(name, NewJob("evaluate", {**task, "policy": str(version)}, episodes), key)

    async def claim(
        self,
        name: str,
        worker: str,
        most_episodes: int,
        lease_seconds: float,
        wait_seconds: float,
        gone: Callable[[], Awaitable[bool]] | None = None,
    ) -> LeasedJob | None:
        """Lease a job; while there is none, wait for one. ``gone`` says whether the worker has left meanwhile.

        Raises:
            UnknownSurrogate: no such surrogate, or it was deleted meanwhile.
        """
        deadline = time.monotonic() + wait_seconds

        def claim() -> LeasedJob | None:
            self._workers.heard(name, worker, most_episodes)
            return self._storage.jobs.claim(name, worker, most_episodes, lease_seconds)

        with self._notices.listen(name) as listener:
            job = await asyncio.to_thread(claim)
            if job is None:
                self._notices.post(name)  # the page shows a worker as soon as it is connected
            while job is None and not self._notices.closing and (left := deadline - time.monotonic()) > 0:
                await listener.wait(min(left, POLL_SECONDS))
                if gone is not None and await gone():
                    return None
                job = await asyncio.to_thread(claim)
        if job is not None:
            self._notices.post(name)
        return job

    def report(self, name: str, id: int, token: str, lease_seconds: float, progress: JobProgress | None) -> bool:
        """Keep a lease, and store how far the job is. Returns whether its worker is to stop.

        Raises:
            UnknownJob, LeaseExpired: as the storage says.
        """
        cancel = self._storage.jobs.report(name, id, token, lease_seconds, progress)
        if worker := self._storage.jobs.get(name, id).worker:
            self._workers.heard(name, worker)
        return cancel

    def finish(self, name: str, id: int, token: str, result: JobResult) -> JobRecord:
        """End a job. Raises ``UnknownJob`` or ``LeaseExpired``, as the storage says."""
        return self._changed(name, self._storage.jobs.finish(name, id, token, result))

    def cancel(self, name: str, id: int) -> JobRecord:
        """Cancel a job that waits, or ask the worker of a running one to stop. Raises ``UnknownJob``."""
        return self._changed(name, self._storage.jobs.cancel(name, id))

    def get(self, name: str, id: int) -> JobRecord:
        """Raises ``UnknownJob``."""
        return self._storage.jobs.get(name, id)

    def list(self, name: str) -> tuple[list[JobRecord], dict[str, int]]:
        """All jobs, newest first, and the most real episodes of each connected worker."""
        return self._storage.jobs.list(name), self._workers.of(name)

    def _add(self, name: str, new: NewJob, key: str | None) -> JobRecord:
        return self._changed(name, self._storage.jobs.get(name, self._storage.jobs.add(name, new, key=key)))

    def _changed(self, name: str, record: JobRecord) -> JobRecord:
        self._notices.post(name)
        return record
