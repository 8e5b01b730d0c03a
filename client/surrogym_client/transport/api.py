"""One typed method for each route of the server, except the routes of sessions."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Literal, Self, TypeVar

from surrogym_client.errors import NoModel, ProtocolMismatch, ServerUnreachable
from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection, Retries, Timeouts
from surrogym_client.transport.routes import check_protocol, new_key, parse
from surrogym_shared import wire
from surrogym_shared.codes import STATUS, Code, Problem
from surrogym_shared.spec import EnvironmentSpec


class JobCalls:
    """Methods for the routes of jobs: trainings and evaluations that trainer workers run.

    Every method raises the errors of ``Api``, and ``UnknownJob`` for a job that does not exist.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def list(self, surrogate: str) -> wire.JobList:
        """List the jobs of a surrogate, newest first, and the workers that are connected."""
        return self._connection.get(wire.JobList, f"{routes.surrogate(surrogate)}/jobs")

    def get(self, surrogate: str, id: int) -> wire.JobDetail:
        """Return one job, with the curve of its training so far."""
        return self._connection.get(wire.JobDetail, routes.job(surrogate, id))

    def add(self, surrogate: str, task: wire.Task, *, idempotency_key: str | None = None) -> wire.JobView:
        """Queue a training or an evaluation.

        Raises:
            NoModel: a training needs a model.
            UnknownPolicy: the policy to evaluate does not exist.
            Overloaded: too many jobs are queued or running.
        """
        body = wire.AddJob(task=task, idempotency_key=idempotency_key)
        return self._connection.post(
            wire.JobView, f"{routes.surrogate(surrogate)}/jobs", body, repeatable=bool(idempotency_key)
        )

    def cancel(self, surrogate: str, id: int) -> wire.JobView:
        """Cancel a queued job, or ask the worker of a running job to stop."""
        return self._connection.post(wire.JobView, f"{routes.job(surrogate, id)}:cancel")

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
        return self._connection.post(wire.ClaimedJob, route, body, timeout=timeout, repeatable=False).job

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
        return self._connection.post(
            wire.ReportedJob, f"{routes.job(surrogate, id)}:report", body, retries=retries
        ).cancel

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
        return self._connection.post(wire.JobView, f"{routes.job(surrogate, id)}:finish", body)


_FILE = "application/octet-stream"
_SECONDS = 300.0  # time-out of a file's transfer, enough for the largest file over a slow connection


class PolicyCalls:
    """Methods for the routes of stored policies. ``which`` is the version of a policy, an alias, or ``latest``.

    Every method raises the errors of ``Api``, and ``UnknownPolicy`` for a policy that does not exist.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def list(self, surrogate: str) -> list[wire.PolicyView]:
        """List all policies of a surrogate, newest first."""
        return self._connection.get(wire.PolicyList, f"{routes.surrogate(surrogate)}/policies").policies

    def get(self, surrogate: str, which: str | int = "latest") -> wire.PolicyDetail:
        """Return one policy, with the settings and the curve of its training."""
        return self._connection.get(wire.PolicyDetail, routes.policy(surrogate, which))

    def push(
        self,
        surrogate: str,
        card: wire.PushedCard,
        curve: Sequence[wire.CurvePoint],
        form: wire.PolicyForm,
        file: bytes,
    ) -> wire.PushedPolicy:
        """Store a policy with its file. A version never changes: the same file with another card is a new version.

        Raises:
            SpecConflict: the policy was made for other observations or actions.
            InvalidInput: the file is not of the form ``form``.
        """
        notice = wire.FileNotice(form=form, bytes=len(file), digest=_digest(file))
        body = wire.AddPolicy(card=card, curve=[*curve], file=notice)
        pushed = self._connection.post(wire.PushedPolicy, f"{routes.surrogate(surrogate)}/policies", body)
        if not all(one.stored for one in pushed.files if one.form == form):
            stored = self.put_file(surrogate, pushed.version, form, file)
            return wire.PushedPolicy(**stored.model_dump(), created=pushed.created)
        return pushed

    def put_file(self, surrogate: str, version: int, form: wire.PolicyForm, file: bytes) -> wire.PolicyView:
        """Store a further file of a policy. A stored file is never replaced: another file of the same form is an
        error."""
        route = f"{routes.policy(surrogate, version)}/files/{form}"
        digest = {"digest": _digest(file)}
        reply = self._connection.send("PUT", route, file, params=digest, media_type=_FILE, timeout=_SECONDS)
        return parse(wire.PolicyView, reply, route)

    def file(self, surrogate: str, which: str | int, form: wire.PolicyForm) -> bytes:
        """Return the content of a policy's file."""
        return self._connection.send("GET", f"{routes.policy(surrogate, which)}/files/{form}", timeout=_SECONDS)

    def evaluate(self, surrogate: str, version: int, evaluation: wire.AddEvaluation) -> wire.EvaluationView:
        """Store the results of real episodes of a policy, once for each idempotency key. This does not change the
        surrogate's counts of real steps, see ``Api.report_steps``."""
        route = f"{routes.policy(surrogate, version)}/evaluations"
        return self._connection.post(wire.EvaluationView, route, evaluation)

    def evaluation(self, surrogate: str, which: str | int, id: int) -> wire.EvaluationDetail:
        """Return the results of a stored evaluation: the return of each real episode, and the traces of some."""
        return self._connection.get(wire.EvaluationDetail, f"{routes.policy(surrogate, which)}/evaluations/{id}")

    def put_alias(self, surrogate: str, alias: str, version: int) -> wire.PolicyView:
        """Point an alias to a version of the policies. This needs a token of role admin."""
        route = f"{routes.policy(surrogate, 'aliases')}/{routes.alias(alias)}"
        return self._connection.post(wire.PolicyView, route, wire.PutAlias(version=version), method="PUT")

    def drop_alias(self, surrogate: str, alias: str) -> None:
        """Remove an alias. This needs a token of role admin."""
        self._connection.send("DELETE", f"{routes.policy(surrogate, 'aliases')}/{routes.alias(alias)}")

    def delete(self, surrogate: str, version: int) -> None:
        """Delete a policy with its files and evaluations. This needs a token of role admin."""
        self._connection.send("DELETE", routes.policy(surrogate, version))


def _digest(file: bytes) -> str:
    return hashlib.sha256(file).hexdigest()


P = TypeVar("P", wire.Uncertainty, wire.Prediction)

_EVENT_SILENCE_SECONDS = 60.0
# Largest count of numbers in a request: each has up to 25 characters, and the server accepts 64 KiB of JSON.
_NUMBERS = 2_000
_OF_ALL_POINTS = ("model_version", "outputs")
_MODEL_FILE = "application/octet-stream"
_BATCH_BYTES = 96 * 1024  # size in bytes of the samples in one request; only the answer to one query may be larger


class Api:
    """Client of a server's HTTP routes, for samplers, dashboards and scripts.

    Every method raises a ``SurrogymClientError``: ``ServerUnreachable`` after the retry budget, or the subclass of
    ``ProblemError`` for the server's answer. Calls that must take effect only once carry an idempotency key, which is
    made here if none is given, so a lost reply never doubles them. Samples of queries need none: their leases identify
    them.

    Args:
        url: the server's address; default ``SURROGYM_URL``, then http://127.0.0.1:8000.
        token: bearer token; default ``SURROGYM_TOKEN``, then the one in the file ``SURROGYM_TOKEN_FILE``.
        timeouts: seconds for each kind of request.
        retries: how long to retry after lost connections, lost replies and status 503.

    Examples:
        >>> with Api() as api:
        ...     api.surrogate("pendulum").phase
    """

    def __init__(
        self,
        url: str | None = None,
        token: str | None = None,
        *,
        timeouts: Timeouts | None = None,
        retries: Retries | None = None,
    ) -> None:
        self.connection = Connection(url, token, timeouts, retries)

    @property
    def url(self) -> str:
        """Address of the server."""
        return self.connection.url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the sockets. A later call opens new ones."""
        self.connection.close()

    # Routes of the server itself

    def health(self) -> wire.Health:
        """Check that a Surrogym server of this protocol answers.

        Raises:
            ProtocolMismatch: the server has another protocol version.
        """
        health = self.connection.get(wire.Health, "/healthz")
        check_protocol(health.protocol, self.url)
        return health

    def ready(self) -> wire.Ready:
        """Check that the server can work: its database answers.

        Raises:
            Unavailable: the database does not answer.
        """
        return self.connection.get(wire.Ready, "/readyz")

    def access(self) -> wire.Access:
        """Return what this token may do.

        Raises:
            Unauthenticated: the server requires a token, and the client has none or an unknown one.
        """
        return self.connection.get(wire.Access, "/v1/access")

    def wait_until_ready(self, seconds: float = 60.0) -> wire.Health:
        """Wait until the server is ready, for at most ``seconds``.

        Raises:
            ServerUnreachable: the server was not ready in time.
        """
        content = self.connection.send("GET", "/readyz", retries=Retries(seconds=seconds))
        parse(wire.Ready, content, "/readyz")
        return self.health()

    # Routes of surrogates

    def create_surrogate(self, name: str, spec: EnvironmentSpec) -> wire.CreatedSurrogate:
        """Register an original environment under a name.

        Repeating it with the same specification is harmless; the reply's ``created`` is then False.
        """
        return self.connection.post(wire.CreatedSurrogate, "/v1/surrogates", wire.CreateSurrogate(name=name, spec=spec))

    def surrogates(self) -> list[wire.SurrogateSummary]:
        """List all surrogates, oldest first, with phase, real steps taken, and confidence index."""
        found: list[wire.SurrogateSummary] = []
        after: int | None = 0
        while after is not None:
            page = self.connection.get(wire.SurrogateList, "/v1/surrogates", after=after)
            found, after = found + page.surrogates, page.next_after
        return found

    def surrogate(self, name: str) -> wire.SurrogateView:
        """Return one surrogate: specification, fidelity of every output, and counts of real steps and of queries.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
        """
        return self.connection.get(wire.SurrogateView, routes.surrogate(name))

    def patch_surrogate(
        self,
        name: str,
        *,
        paused: bool | None = None,
        budget: int | None = None,
        target: float | None = None,
        tolerances: Mapping[str, float | None] | None = None,
    ) -> wire.SurrogateView:
        """Pause or resume the design, or change its budget, target or tolerances.

        An argument of None leaves a field as it is. A tolerance of None returns that output to its default tolerance.
        """
        given = None if tolerances is None else dict(tolerances)
        body = wire.PatchSurrogate(paused=paused, budget=budget, target=target, tolerances=given)
        return self.connection.post(wire.SurrogateView, routes.surrogate(name), body, method="PATCH")

    def delete_surrogate(self, name: str) -> None:
        """Delete a surrogate with its samples, models and sessions. This can't be undone.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
        """
        self.connection.send("DELETE", routes.surrogate(name))

    # Routes of queries

    def claim(
        self,
        name: str,
        sampler: str,
        *,
        max_queries: int = 1,
        wait_seconds: float = 0.0,
        lease_seconds: float = wire.QUERY_LEASE_SECONDS,
        retries: Retries | None = None,
    ) -> wire.ClaimedQueries:
        """Lease up to ``max_queries`` queries for a sampler, and wait up to ``wait_seconds`` for the first one. The
        reply may have none. ``retries`` replaces the retry budget of the connection.

        A claim whose reply is lost is not sent again. Its leases expire, and the queries return to the queue.

        Raises:
            ProtocolMismatch: the server returned more than ``max_queries``.
        """
        body = wire.ClaimQueries(
            sampler=sampler, max_queries=max_queries, wait_seconds=wait_seconds, lease_seconds=lease_seconds
        )
        claimed = self.connection.post(
            wire.ClaimedQueries,
            f"{routes.surrogate(name)}/queries:claim",
            body,
            timeout=self.connection.timeouts.request + wait_seconds,
            repeatable=False,
            retries=retries,
        )
        if len(claimed.queries) > max_queries:
            raise ProtocolMismatch(
                f"expected at most {max_queries} queries in the reply to a claim, got {len(claimed.queries)}: upgrade "
                "the server"
            )
        return claimed

    def renew(
        self,
        name: str,
        query_id: int,
        lease_token: str,
        *,
        lease_seconds: float = wire.QUERY_LEASE_SECONDS,
        retries: Retries | None = None,
    ) -> None:
        """Extend the lease of a query. ``retries`` replaces the retry budget of the connection.

        Raises:
            LeaseExpired: the lease has expired; the sample may still be sent.
        """
        body = wire.RenewLease(lease_token=lease_token, lease_seconds=lease_seconds)
        route = f"{routes.surrogate(name)}/queries/{query_id}:renew"
        self.connection.send("POST", route, body.model_dump_json().encode(), retries=retries)

    def fail(
        self, name: str, query_id: int, lease_token: str, error: str, *, begun: bool = True, refused: bool = False
    ) -> None:
        """Hand a query back to the server without an answer, with the error it caused. ``begun``: whether a real step
        may have been taken. ``refused``: whether the original environment refused the query before a real step."""
        body = wire.FailQuery(lease_token=lease_token, error=error, begun=begun, refused=refused)
        route = f"{routes.surrogate(name)}/queries/{query_id}:fail"
        self.connection.send("POST", route, body.model_dump_json().encode())

    def add_queries(
        self,
        name: str,
        coordinates: Sequence[Sequence[float]] = (),
        action: Sequence[Sequence[float]] = (),
        *,
        rollouts: Sequence[Sequence[Sequence[float]]] = (),
        policy: str | None = None,
        replan: bool = False,
        audit: bool = False,
        idempotency_key: str | None = None,
    ) -> list[wire.QueryView]:
        """Add queries of your own to the queue.

        Give n queries of one step by their states, ``coordinates`` (n, C), and their actions, ``action`` (n, F); or
        give ``rollouts``, each T actions (T, F) from a reset, which are only expected if a ``policy`` (its file in
        base64) chooses them, or if the sampler plans each action anew (``replan``). Queries of an audit don't count
        towards the budget.
        """
        body = (wire.AuditModel if audit else wire.AddQueries)(
            coordinates=[list(row) for row in coordinates] or None,
            action=[list(row) for row in action] or None,
            rollouts=[[list(row) for row in actions] for actions in rollouts] or None,
            policy=policy,
            replan=replan,
            idempotency_key=idempotency_key or new_key(),
        )
        return self.connection.post(
            wire.QueryList, f"{routes.surrogate(name)}/{'audit' if audit else 'queries'}", body
        ).queries

    def withdraw_audit(self, name: str, query_ids: Sequence[int]) -> int:
        """Withdraw queries of an audit, or trials, that no sampler has begun, and return how many were withdrawn."""
        body = wire.WithdrawQueries(query_ids=list(query_ids))
        return self.connection.post(wire.WithdrawnQueries, f"{routes.surrogate(name)}/audit:withdraw", body).withdrawn

    def queries(self, name: str) -> list[wire.QueryView]:
        """List all queries so far, each with its state, attempts and last error."""
        return self.connection.get(wire.QueryList, f"{routes.surrogate(name)}/queries").queries

    # Routes of snapshots, samples, and counts of real steps

    def snapshots(self, name: str) -> list[wire.SnapshotView]:
        """Return the snapshots that samplers hold, oldest first."""
        return self.connection.get(wire.SnapshotList, f"{routes.surrogate(name)}/snapshots").snapshots

    def drop_snapshots(self, name: str, snapshots: Sequence[str]) -> int:
        """Report snapshots that no sampler holds any more, and return how many of them the server knew."""
        body = wire.DropSnapshots(snapshots=list(snapshots))
        return self.connection.post(wire.DroppedSnapshots, f"{routes.surrogate(name)}/snapshots:drop", body).dropped

    def add_samples(
        self,
        name: str,
        sampler: str,
        samples: Sequence[wire.NewSample],
        *,
        purpose: Literal["manual", "logged"] = "manual",
        complete: bool = True,
        after: str | None = None,
        idempotency_key: str | None = None,
        stored: Callable[[wire.AddedSamples], None] = lambda _: None,
    ) -> wire.AddedSamples:
        """Send real steps, and return once the server has stored them.

        Steps of purpose ``logged`` were recorded before: they don't count towards the budget, and storing a log twice
        changes nothing. A log may be sent in several calls: ``after`` is the ``digest`` of the reply to the previous
        part, and ``complete`` is true for the last part, which starts a fit. If the field ``restart`` of a reply is not
        None, no part of the log is stored: send the log again from its beginning, with the value of ``restart`` as
        ``after``. A call without ``after`` does this by itself.

        A batch of up to about 300 samples is stored whole or not at all. A larger one is sent in several requests, so
        an error may leave its first part stored; the same call with the same key then adds the rest. ``stored`` is
        called after each request that the server has answered, with a reply for all requests so far.
        """
        batches = _batches(samples)
        keys: list[str | None] = [None] * len(batches)
        # Samples of queries need no key: the lease of the query shows whether they were sent before.
        if idempotency_key or any(sample.query_id is None for sample in samples):
            key = idempotency_key or new_key()
            keys = [key] if len(batches) == 1 else [f"{key}/{number}" for number in range(len(batches))]
        added: list[wire.AddedSamples] = []
        begins, place = after is None, after
        while len(added) < len(batches):
            batch = batches[len(added)]
            body = wire.AddSamples(
                sampler=sampler,
                samples=batch,
                purpose=purpose,
                complete=complete and batch is batches[-1],
                after=place,
                idempotency_key=keys[len(added)],
            )
            reply = self.connection.post(wire.AddedSamples, f"{routes.surrogate(name)}/add_sample", body)
            if reply.restart is not None and not begins:
                return reply
            added, place = ([*added, reply], reply.digest) if reply.restart is None else ([], reply.restart)
            stored(_joined(added or [reply]))
        return _joined(added)

    def samples(self, name: str) -> Iterator[wire.SampleView]:
        """Iterate over all samples in order of arrival, page by page."""
        after: int | None = 0
        while after is not None:
            page = self.connection.get(wire.SamplePage, f"{routes.surrogate(name)}/samples", after=after)
            yield from page.samples
            after = page.next_after

    def export_samples(self, name: str, file_format: Literal["csv", "npz"]) -> bytes:
        """Return all samples as the content of one CSV or NPZ file."""
        return self.connection.send("GET", f"{routes.surrogate(name)}/samples", params={"format": file_format})

    def dirt(self, name: str) -> list[wire.DirtFinding]:
        """Return the dirt that was found in the first real steps of a machine that can only be reset."""
        return self.connection.get(wire.DirtList, f"{routes.surrogate(name)}/dirt").findings

    def limits(self, name: str) -> list[str]:
        """Describe in sentences how well all real steps kept the limits of the specification; empty without limits."""
        return self.connection.get(wire.LimitsKept, f"{routes.surrogate(name)}/limits").said

    def report_steps(
        self,
        name: str,
        steps: int,
        *,
        episodes: int = 0,
        note: str = "",
        limits: wire.LimitCounts | None = None,
        idempotency_key: str | None = None,
    ) -> wire.Ledger:
        """Report the number of real steps of an evaluation, and how its episodes kept ``limits``. Return the
        surrogate's counts of real steps."""
        key = idempotency_key or new_key()
        body = wire.ReportSteps(steps=steps, episodes=episodes, note=note, limits=limits, idempotency_key=key)
        return self.connection.post(wire.Ledger, f"{routes.surrogate(name)}/ledger", body)

    def improve(
        self,
        name: str,
        queries: int | None = None,
        *,
        checkpoint: str | None = None,
        trial: wire.Trial | None = None,
        idempotency_key: str | None = None,
    ) -> wire.ImprovedSurrogate:
        """Add queries to the design, chosen near the visited states that were submitted as ``checkpoint``; or else a
        trial, in which a policy acts.

        Raises:
            BeyondBudget: the budget has too few steps left, and this token may not raise it; a token of role admin may.
        """
        key = idempotency_key or new_key()
        body = wire.Improve(queries=queries, checkpoint=checkpoint, trial=trial, idempotency_key=key)
        return self.connection.post(wire.ImprovedSurrogate, f"{routes.surrogate(name)}/improve", body)

    # Routes of models, and of the states of sessions

    def session_coordinates(self, session: str) -> list[list[float]]:
        """Return the coordinates (N, C) of the N lanes of a session."""
        return self.connection.get(wire.SessionCoordinates, f"{routes.session(session)}/coordinates").coordinates

    def query_uncertainty(
        self,
        name: str,
        coordinates: Sequence[Sequence[float]],
        action: Sequence[Sequence[float]],
        *,
        model: int | None = None,
    ) -> wire.Uncertainty:
        """Return the model's mean, standard deviation and uncertainty index at coordinates (n, C) and actions (n,
        F)."""
        return self._of_points(
            wire.Uncertainty, f"{routes.surrogate(name)}/query_uncertainty", coordinates, action, model
        )

    def predict(
        self,
        name: str,
        coordinates: Sequence[Sequence[float]],
        action: Sequence[Sequence[float]],
        *,
        model: int | None = None,
    ) -> wire.Prediction:
        """Predict one transition from each of the coordinates (n, C) under its action (n, F)."""
        return self._of_points(wire.Prediction, f"{routes.surrogate(name)}/predict", coordinates, action, model)

    def models(self, name: str) -> list[wire.ModelView]:
        """List all models with structure, hyperparameters and fidelity, oldest first."""
        return self.connection.get(wire.ModelList, f"{routes.surrogate(name)}/models").models

    def model(self, name: str) -> wire.ModelView:
        """Return the structure and fidelity of the latest model.

        Raises:
            NoModel: there was no fit yet.
        """
        view = self.surrogate(name)
        if view.model_version is None:
            detail = f"{name!r} has no model yet: let a sampler answer its first queries, or import a log"
            raise NoModel(Problem(title="No model", status=STATUS[Code.NO_MODEL], code=Code.NO_MODEL, detail=detail))
        return self.connection.get(wire.ModelView, f"{routes.surrogate(name)}/models/{view.model_version}")

    def export_model(self, name: str, version: int) -> bytes:
        """Return a complete model as the content of a safetensors file."""
        route = f"{routes.surrogate(name)}/models/{version}"
        return self.connection.send("GET", route, params={"format": "safetensors"})

    def import_model(self, name: str, data: bytes) -> wire.ModelView:
        """Store an exported model as the newest version of a surrogate with the same outputs."""
        route = f"{routes.surrogate(name)}/models"
        reply = self.connection.send("POST", route, data, media_type=_MODEL_FILE, repeatable=False)
        return parse(wire.ModelView, reply, route)

    # Routes of policies

    @property
    def policies(self) -> PolicyCalls:
        """Methods for the routes of policies."""
        return PolicyCalls(self.connection)

    # Routes of jobs

    @property
    def jobs(self) -> JobCalls:
        """Methods for the routes of jobs."""
        return JobCalls(self.connection)

    # Route of events

    def events(self, name: str, after: int | None = None) -> Iterator[wire.Event]:
        """Iterate over the events of a surrogate without end. A broken stream continues after the last event received.

        Args:
            name: name of the surrogate.
            after: id of the last event already known; None starts with events from now on.

        Raises:
            ServerUnreachable: the stream stayed broken for the retry budget.
        """
        delays: Iterator[float] | None = None
        while True:
            try:
                for event in self._one_stream(name, after):
                    delays = None
                    if event is not None:
                        after = event.id
                        yield event
            except ServerUnreachable:
                delays = self.connection.retries.delays() if delays is None else delays
                pause = next(delays, None)
                if pause is None:
                    raise
                time.sleep(pause)

    def _one_stream(self, name: str, after: int | None) -> Iterator[wire.Event | None]:
        """Yield the events of one connection, and None for a keep-alive message, until an error is raised."""
        path = f"{routes.surrogate(name)}/events"
        headers = {"Accept": "text/event-stream"}
        if after is not None:
            headers["Last-Event-ID"] = str(after)
        with self.connection.stream(path, headers, _EVENT_SILENCE_SECONDS) as lines:
            for line in lines:
                if line.startswith("data:"):
                    yield parse(wire.Event, line.removeprefix("data:").strip().encode(), path)
                elif line.startswith(":"):
                    yield None
        raise ServerUnreachable(f"the server at {self.url} ended the stream of events: connect again")

    def _of_points(
        self,
        reply: type[P],
        path: str,
        coordinates: Sequence[Sequence[float]],
        action: Sequence[Sequence[float]],
        model: int | None,
    ) -> P:
        """Evaluate a model at any number of points, in requests that are small enough for the server."""
        if len(coordinates) != len(action):
            raise ValueError(
                f"expected one action for each state, got {len(action)} actions and {len(coordinates)} states"
            )
        parts: list[P] = []
        size = max(1, _NUMBERS // max(1, len([*coordinates[0], *action[0]]))) if coordinates else 1
        for start in range(0, len(coordinates), size) or [0]:
            rows = slice(start, start + size)
            body = wire.Points(
                coordinates=[list(row) for row in coordinates[rows]],
                action=[list(row) for row in action[rows]],
                model=parts[0].model_version if parts else model,
            )
            parts.append(self.connection.post(reply, path, body))
        by_point = {
            field: [row for part in parts for row in getattr(part, field)]
            for field in reply.model_fields
            if field not in _OF_ALL_POINTS
        }
        return parts[0].model_copy(update=by_point)


def _joined(added: Sequence[wire.AddedSamples]) -> wire.AddedSamples:
    """Combine the replies to several requests with samples into one reply."""
    ids = [id for one in added for id in one.sample_ids]
    return added[-1].model_copy(update={"sample_ids": ids, "duplicates": sum(one.duplicates for one in added)})


def _batches(samples: Sequence[wire.NewSample]) -> list[list[wire.NewSample]]:
    """Split samples into batches of at most ``_BATCH_BYTES``. The answer to one query stays in one batch, because the
    server takes it whole. There is always at least one batch, which may be empty."""
    batches: list[list[wire.NewSample]] = [[]]
    room = _BATCH_BYTES
    for query, group in groupby(samples, lambda sample: sample.query_id):
        for part in [list(group)] if query is not None else [[sample] for sample in group]:
            size = sum(len(sample.model_dump_json()) + 1 for sample in part)
            if size > room and batches[-1]:
                batches.append([])
                room = _BATCH_BYTES
            batches[-1] += part
            room -= size
    return batches
