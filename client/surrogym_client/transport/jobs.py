"""One typed method for each route of jobs."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel

from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection, Retries
from surrogym_client.transport.replies import parse
from surrogym_shared import wire

R = TypeVar("R", bound=wire.Reply)


class JobCalls:
    """Methods for the routes of jobs: trainings and evaluations that trainer workers run.

    Every method raises the errors of ``Api``, and ``UnknownJob`` for a job that does not exist.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def list(self, surrogate: str) -> wire.JobList:
        """List the jobs of a surrogate, newest first, and the workers that are connected."""
        route = f"{routes.surrogate(surrogate)}/jobs"
        return parse(wire.JobList, self._connection.send("GET", route), route)

    def get(self, surrogate: str, id: int) -> wire.JobDetail:
        """Return one job, with the curve of its training so far."""
        route = routes.job(surrogate, id)
        return parse(wire.JobDetail, self._connection.send("GET", route), route)

    def add(self, surrogate: str, task: wire.Task, *, idempotency_key: str | None = None) -> wire.JobView:
        """Queue a training or an evaluation.

        Raises:
            NoModel: a training needs a model.
            UnknownPolicy: the policy to evaluate does not exist.
            Overloaded: too many jobs are queued or running.
        """
        body = wire.AddJob(task=task, idempotency_key=idempotency_key)
        return self._post(wire.JobView, f"{routes.surrogate(surrogate)}/jobs", body, repeatable=bool(idempotency_key))

    def cancel(self, surrogate: str, id: int) -> wire.JobView:
        """Cancel a queued job, or ask the worker of a running job to stop."""
        route = f"{routes.job(surrogate, id)}:cancel"
        return parse(wire.JobView, self._connection.send("POST", route), route)

    def claim(
        self,
        surrogate: str,
        worker: str,
        *,
        most_episodes: int = 0,
        reference: bool = False,
        wait_seconds: float = 0.0,
        lease_seconds: float = wire.JOB_LEASE_SECONDS,
    ) -> wire.LeasedJob | None:
        """Lease a job for a worker, and wait up to ``wait_seconds`` until there is one.

        A claim whose reply is lost is not sent again. Its lease expires, and the job returns to the queue.

        Args:
            surrogate: name of the surrogate.
            worker: name of the worker.
            most_episodes: largest number of real episodes of an evaluation that the worker accepts; 0: trainings only.
            reference: whether the worker has a reference controller, which some evaluations need.
            wait_seconds: longest wait for a job.
            lease_seconds: length of the lease.
        """
        body = wire.ClaimJob(
            worker=worker,
            most_episodes=most_episodes,
            reference=reference,
            wait_seconds=wait_seconds,
            lease_seconds=lease_seconds,
        )
        timeout = self._connection.timeouts.request + wait_seconds
        route = f"{routes.surrogate(surrogate)}/jobs:claim"
        return self._post(wire.ClaimedJob, route, body, timeout=timeout, repeatable=False).job

    def report(
        self,
        surrogate: str,
        id: int,
        lease_token: str,
        *,
        state: wire.JobState | None = None,
        lease_seconds: float = wire.JOB_LEASE_SECONDS,
        retries: Retries | None = None,
    ) -> bool:
        """Renew the lease of a job, and store its progress. Returns whether the worker has to stop, because a person
        cancelled the job.

        Raises:
            LeaseExpired: the job has ended, or another worker has it.
        """
        body = wire.ReportJob(lease_token=lease_token, lease_seconds=lease_seconds, state=state)
        return self._post(wire.ReportedJob, f"{routes.job(surrogate, id)}:report", body, retries=retries).cancel

    def finish(
        self,
        surrogate: str,
        id: int,
        lease_token: str,
        status: wire.JobEnd,
        *,
        error: str | None = None,
        version: int | None = None,
        evaluation: int | None = None,
    ) -> wire.JobView:
        """Report that a job has ended. Repeating it is harmless. Raises ``LeaseExpired`` if another worker has it."""
        body = wire.FinishJob(
            lease_token=lease_token, status=status, error=error, version=version, evaluation=evaluation
        )
        return self._post(wire.JobView, f"{routes.job(surrogate, id)}:finish", body)

    def _post(
        self,
        reply: type[R],
        route: str,
        body: BaseModel,
        *,
        timeout: float | None = None,
        repeatable: bool = True,
        retries: Retries | None = None,
    ) -> R:
        content = body.model_dump_json().encode()
        options = {"timeout": timeout, "repeatable": repeatable, "retries": retries}
        return parse(reply, self._connection.send("POST", route, content, **options), route)  # type: ignore[arg-type]
