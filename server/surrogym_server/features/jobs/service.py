"""The service of jobs: it queues jobs for people, and leases them to trainer workers, which can wait for a job. It
knows which workers called recently, and which jobs they accept."""

from __future__ import annotations

import asyncio
from typing import NamedTuple, Self

from surrogym_server.api.door import Waiting
from surrogym_server.errors import UnknownPolicy
from surrogym_server.feature import Core, Service
from surrogym_server.features.jobs.records import JobProgress, JobRecord, JobResult, LeasedJob, NewJob
from surrogym_server.features.jobs.store import Jobs
from surrogym_server.services.activity import Alive
from surrogym_server.services.claim_queues import ClaimQueues, Present
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import JSON
from surrogym_server.storage.sql import Storage


class _Claim(NamedTuple):
    """Answer to a worker's claim: a leased job, or None."""

    job: LeasedJob | None


class JobService(Service):
    """Queues jobs, and leases them to trainer workers."""

    def __init__(self, storage: Storage, notices: Notices, metrics: ProcessMetrics) -> None:
        self.claims = Waiting("waiting claims of jobs")
        self._storage = storage
        self._jobs = storage.part(Jobs)
        self._notices = notices
        self._metrics = metrics
        self._workers = Workers()
        self._queues = ClaimQueues[_Claim](notices, has_work=lambda claim: claim.job is not None)

    @classmethod
    def start(cls, core: Core) -> Self:
        return cls(core.storage, core.notices, core.metrics)

    async def sweep(self) -> None:
        """End the expired leases of jobs."""
        self._metrics.expired_leases += await asyncio.to_thread(self._jobs.sweep_expired)

    def train(self, name: str, task: JSON, key: str | None) -> JobRecord:
        """Queue a training, once for each idempotency key; ``task`` has its settings.

        Raises:
            NoModel: the surrogate has no model yet.
            Overloaded: the surrogate has too many queued or running jobs.
        """
        self._storage.models.get(name)
        return self._add(name, NewJob("train", task), key)

    def evaluate(self, name: str, task: JSON, episodes: int, key: str | None) -> JobRecord:
        """Queue an evaluation of ``episodes`` real episodes, once for each idempotency key.

        An alias of the policy in ``task`` is replaced by its version.

        Raises:
            UnknownPolicy: the policy does not exist.
            Overloaded: the surrogate has too many queued or running jobs.
        """
        version = self._storage.policy_names.version(name, task["policy"])
        return self._add(name, NewJob("evaluate", {**task, "policy": str(version)}, episodes), key)

    async def claim(
        self,
        name: str,
        worker: str,
        offer: Offer,
        lease_seconds: float,
        wait_seconds: float,
        present: Present | None = None,
    ) -> LeasedJob | None:
        """Lease the oldest suitable job to a worker. If there is none, wait for one.

        Args:
            name: name of the surrogate.
            worker: name of the worker.
            offer: the jobs that the worker accepts.
            lease_seconds: duration of the lease.
            wait_seconds: longest wait.
            present: raises if the worker has closed its connection, which then gets no lease.

        Returns:
            The leased job; None if no job came in time.

        Raises:
            UnknownSurrogate: the surrogate does not exist, or was deleted during the wait.
        """
        most, reference = offer

        def claim() -> _Claim:
            return _Claim(self._jobs.claim(name, worker, most, lease_seconds, reference=reference))

        if self._workers.heard(name, worker, offer):
            self._notices.post(name)  # so that the dashboard shows a new worker at once
        claimed = await self._queues.claim(name, offer, claim, wait_seconds, present)
        self._workers.heard(name, worker)
        if claimed.job is not None:
            self._notices.post(name)
        return claimed.job

    def report(self, name: str, id: int, token: str, lease_seconds: float, progress: JobProgress | None) -> bool:
        """Renew the lease of a job, and store its progress (None: keep the stored progress). Return whether the worker
        has to stop.

        Raises:
            UnknownJob: the job does not exist.
            LeaseExpired: the job has ended, or another worker has leased it.
        """
        cancel = self._jobs.report(name, id, token, lease_seconds, progress)
        if worker := self._jobs.get(name, id).worker:
            self._workers.heard(name, worker)
        return cancel

    def finish(self, name: str, id: int, token: str, result: JobResult) -> JobRecord:
        """End a job with its result. A repeat changes nothing.

        Raises:
            UnknownJob: the job does not exist.
            UnknownPolicy: the policy or the evaluation in the result does not exist.
            LeaseExpired: another worker has leased the job.
        """
        if result.version is not None:
            names, version, evaluation = self._storage.policy_names, result.version, result.evaluation
            names.version(name, str(version))
            if evaluation is not None and not names.has_evaluation(name, version, evaluation):
                raise UnknownPolicy(
                    f"expected the id of an evaluation of version {result.version} of {name!r}'s policies, got "
                    f"{result.evaluation}, which does not exist"
                )
        return self._changed(name, self._jobs.finish(name, id, token, result))

    def cancel(self, name: str, id: int) -> JobRecord:
        """Cancel a queued job, or ask the worker of a running one to stop. Raises ``UnknownJob``."""
        return self._changed(name, self._jobs.cancel(name, id))

    def get(self, name: str, id: int) -> JobRecord:
        """Return a job. Raises ``UnknownJob``."""
        return self._jobs.get(name, id)

    def list(self, name: str) -> tuple[list[JobRecord], dict[str, Offer]]:
        """Return the jobs of a surrogate, newest first, and the offer (accepted jobs) of each connected worker, by the
        worker's name."""
        return self._jobs.list(name), self._workers.of(name)

    def _add(self, name: str, new: NewJob, key: str | None) -> JobRecord:
        return self._changed(name, self._jobs.get(name, self._jobs.add(name, new, key=key)))

    def _changed(self, name: str, record: JobRecord) -> JobRecord:
        self._notices.post(name)
        return record


class Offer(NamedTuple):
    """Which jobs a trainer worker accepts: the largest number of real episodes of an evaluation, and whether it has a
    reference controller."""

    most_episodes: int = 0
    reference: bool = False


class Workers(Alive[Offer]):
    """Time of the last call of each trainer worker, and the jobs that it accepts (its offer)."""

    def heard(self, surrogate: str, worker: str, offer: Offer | None = None) -> bool:
        """Record a claim or report of a worker, and return whether the worker is new. An ``offer`` of None keeps the
        worker's earlier offer."""
        if offer is None:
            _, offer = self._heard.get(surrogate, {}).get(worker, (0.0, Offer()))
        return self.note(surrogate, worker, offer)

    def of(self, surrogate: str) -> dict[str, Offer]:
        """Return the offers of a surrogate's workers that called recently, by the worker's name."""
        return {worker: offer for owner, worker, offer in self.alive() if owner == surrogate}
