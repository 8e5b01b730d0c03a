"""Every route but the sessions', one typed method each."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Self, TypeVar
from uuid import uuid4

from pydantic import BaseModel

from surrogym_client.errors import NoModel, ProtocolMismatch, ServerUnreachable
from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection, Retries, Timeouts
from surrogym_client.transport.policies import PolicyCalls
from surrogym_client.transport.replies import parse
from surrogym_shared import wire
from surrogym_shared.codes import STATUS, Code, Problem
from surrogym_shared.spec import EnvironmentSpec

R = TypeVar("R", bound=wire.Reply)
P = TypeVar("P", wire.Uncertainty, wire.Prediction)

_EVENT_SILENCE_SECONDS = 60.0
_NUMBERS = 2_000  # in one request about points: each has up to 25 characters, and the server takes 64 KiB of JSON
_OF_ALL_POINTS = ("model_version", "outputs")
_MODEL_FILE = "application/octet-stream"
_BATCH_BYTES = 96 * 1024  # of samples in one request; the server takes 128 KiB of JSON


class Api:
    """The service, as a sampler, a dashboard or a person at a prompt uses it.

    Every method raises a ``SurrogymClientError``: ``ServerUnreachable`` after the retry budget, or the
    subclass of ``ProblemError`` that stands for the server's answer. Calls that must happen once carry an
    idempotency key, made here where none is given, so a lost reply never doubles them.

    Args:
        url: the server's address; default ``SURROGYM_URL``, then http://127.0.0.1:8000.
        token: bearer token; default ``SURROGYM_TOKEN``, then the one in the file ``SURROGYM_TOKEN_FILE``.
        timeouts: seconds per kind of request.
        retries: how long to go on after lost connections, lost replies and 503.

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

    @classmethod
    def over(cls, connection: Connection) -> Self:
        """The service over a connection that is there already."""
        api = cls.__new__(cls)
        api.connection = connection
        return api

    @property
    def url(self) -> str:
        """Where the server is."""
        return self.connection.url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the sockets; a later call connects anew."""
        self.connection.close()

    # Service

    def health(self) -> wire.Health:
        """That a Surrogym server of this protocol answers.

        Raises:
            ProtocolMismatch: it speaks another version.
        """
        health = self._get(wire.Health, "/healthz")
        check_protocol(health.protocol, self.url)
        return health

    def ready(self) -> wire.Ready:
        """That the server can work: its database answers.

        Raises:
            Unavailable: it does not.
        """
        return self._get(wire.Ready, "/readyz")

    def access(self) -> wire.Access:
        """What this token may do.

        Raises:
            Unauthenticated: the server asks for a token, and there is none, or an unknown one.
        """
        return self._get(wire.Access, "/v1/access")

    def wait_until_ready(self, seconds: float = 60.0) -> wire.Health:
        """Wait for the server to come up.

        Raises:
            ServerUnreachable: it did not within ``seconds``.
        """
        content = self.connection.send("GET", "/readyz", retries=Retries(seconds=seconds))
        parse(wire.Ready, content, "/readyz")
        return self.health()

    # Surrogates

    def create_surrogate(self, name: str, spec: EnvironmentSpec) -> wire.CreatedSurrogate:
        """Register an original environment; the same name with the same specification is harmless, and ``created`` of
        the reply is False then."""
        return self._post(wire.CreatedSurrogate, "/v1/surrogates", wire.CreateSurrogate(name=name, spec=spec))

    def surrogates(self) -> list[wire.SurrogateSummary]:
        """All of them, oldest first, with phase, what was spent, and confidence."""
        found: list[wire.SurrogateSummary] = []
        after: int | None = 0
        while after is not None:
            page = self._get(wire.SurrogateList, "/v1/surrogates", after=after)
            found, after = found + page.surrogates, page.next_after
        return found

    def surrogate(self, name: str) -> wire.SurrogateView:
        """One, with its specification, the fidelity of every output, its ledger and counts of queries.

        Raises:
            UnknownSurrogate: there is none of this name.
        """
        return self._get(wire.SurrogateView, routes.surrogate(name))

    def patch_surrogate(
        self,
        name: str,
        *,
        paused: bool | None = None,
        budget: int | None = None,
        target: float | None = None,
        tolerances: Mapping[str, float | None] | None = None,
    ) -> wire.SurrogateView:
        """Pause or resume the design, or change its budget, target or tolerances; None leaves a field as it is, and in
        ``tolerances`` it takes back what was set."""
        given = None if tolerances is None else dict(tolerances)
        body = wire.PatchSurrogate(paused=paused, budget=budget, target=target, tolerances=given)
        return self._post(wire.SurrogateView, routes.surrogate(name), body, method="PATCH")

    def delete_surrogate(self, name: str) -> None:
        """Remove it with its samples, models and sessions; there is no way back.

        Raises:
            UnknownSurrogate: there is none of this name.
        """
        self.connection.send("DELETE", routes.surrogate(name))

    # Queries

    def claim(
        self,
        name: str,
        sampler: str,
        *,
        max_queries: int = 1,
        wait_seconds: float = 0.0,
        lease_seconds: float = 60.0,
    ) -> wire.ClaimedQueries:
        """Lease queries to answer; waits up to ``wait_seconds`` for some. An empty list is no error.

        A claim whose reply is lost is not sent again: its leases run out, and the queries come back.

        Raises:
            ProtocolMismatch: the server gave more than ``max_queries``.
        """
        body = wire.ClaimQueries(
            sampler=sampler, max_queries=max_queries, wait_seconds=wait_seconds, lease_seconds=lease_seconds
        )
        claimed = self._post(
            wire.ClaimedQueries,
            f"{routes.surrogate(name)}/queries:claim",
            body,
            timeout=self.connection.timeouts.request + wait_seconds,
            repeatable=False,
        )
        if len(claimed.queries) > max_queries:
            raise ProtocolMismatch(f"expected {max_queries} queries of a claim at most, got {len(claimed.queries)}")
        return claimed

    def renew(
        self,
        name: str,
        query_id: int,
        lease_token: str,
        *,
        lease_seconds: float = 60.0,
        retries: Retries | None = None,
    ) -> None:
        """Keep a lease alive while the original environment works; ``retries`` replaces the connection's.

        Raises:
            LeaseExpired: it has ended; the answer may still be sent.
        """
        body = wire.RenewLease(lease_token=lease_token, lease_seconds=lease_seconds)
        self._send(f"{routes.surrogate(name)}/queries/{query_id}:renew", body, retries=retries)

    def fail(self, name: str, query_id: int, lease_token: str, error: str, *, begun: bool = True) -> None:
        """Give a query back with the error it caused, and whether a real step may have been taken."""
        body = wire.FailQuery(lease_token=lease_token, error=error, begun=begun)
        self._send(f"{routes.surrogate(name)}/queries/{query_id}:fail", body)

    def add_queries(
        self,
        name: str,
        coordinates: Sequence[Sequence[float]] = (),
        action: Sequence[Sequence[float]] = (),
        *,
        rollouts: Sequence[Sequence[Sequence[float]]] = (),
        audit: bool = False,
        idempotency_key: str | None = None,
    ) -> list[wire.QueryView]:
        """Put queries of one's own into the queue: coordinates (n, C) and action (n, F); or, where the original
        environment can only be reset, action sequences, each (T, F). Those of an audit cost none of the budget."""
        body = (wire.AuditModel if audit else wire.AddQueries)(
            coordinates=[list(row) for row in coordinates] or None,
            action=[list(row) for row in action] or None,
            rollouts=[[list(row) for row in actions] for actions in rollouts] or None,
            idempotency_key=idempotency_key or new_key(),
        )
        return self._post(wire.QueryList, f"{routes.surrogate(name)}/{'audit' if audit else 'queries'}", body).queries

    def withdraw_audit(self, name: str, query_ids: Sequence[int]) -> int:
        """Take queries of an audit back that no sampler has begun; gives how many that were."""
        body = wire.WithdrawQueries(query_ids=list(query_ids))
        return self._post(wire.WithdrawnQueries, f"{routes.surrogate(name)}/audit:withdraw", body).withdrawn

    def queries(self, name: str) -> list[wire.QueryView]:
        """Every query ever asked, with its state, attempts and last error."""
        return self._get(wire.QueryList, f"{routes.surrogate(name)}/queries").queries

    # Samples and the ledger

    def add_samples(
        self,
        name: str,
        sampler: str,
        samples: Sequence[wire.NewSample],
        *,
        purpose: Literal["manual", "logged"] = "manual",
        complete: bool = True,
        idempotency_key: str | None = None,
    ) -> wire.AddedSamples:
        """Hand in real steps; the answer comes after they are stored for good.

        ``logged`` ones were recorded before: they cost no budget, and those that are there already change nothing. A
        fit becomes due for them with the call that makes the log ``complete``.

        A batch of up to about 300 samples is stored whole or not at all. A larger one is sent in several requests, so
        that an error may leave its first part stored; the same call with the same key then adds the rest.
        """
        key = idempotency_key or new_key()
        batches = _batches(samples)
        keys: list[str | None] = [key] if len(batches) == 1 else [f"{key}/{number}" for number in range(len(batches))]
        added = [
            self._post(
                wire.AddedSamples,
                f"{routes.surrogate(name)}/add_sample",
                wire.AddSamples(
                    sampler=sampler,
                    samples=batch,
                    purpose=purpose,
                    complete=complete and batch is batches[-1],
                    idempotency_key=key,
                ),
            )
            for key, batch in zip(keys, batches, strict=True)
        ]
        return wire.AddedSamples(
            sample_ids=[id for one in added for id in one.sample_ids],
            duplicates=sum(one.duplicates for one in added),
            ledger=added[-1].ledger,
        )

    def samples(self, name: str) -> Iterator[wire.SampleView]:
        """All samples in order of arrival, page by page."""
        after: int | None = 0
        while after is not None:
            page = self._get(wire.SamplePage, f"{routes.surrogate(name)}/samples", after=after)
            yield from page.samples
            after = page.next_after

    def export_samples(self, name: str, file_format: Literal["csv", "npz"]) -> bytes:
        """All samples as one file."""
        return self.connection.send("GET", f"{routes.surrogate(name)}/samples", params={"format": file_format})

    def report_steps(
        self, name: str, steps: int, *, episodes: int = 0, note: str = "", idempotency_key: str | None = None
    ) -> wire.Ledger:
        """Enter real steps of an evaluation into the ledger."""
        body = wire.ReportSteps(steps=steps, episodes=episodes, note=note, idempotency_key=idempotency_key or new_key())
        return self._post(wire.Ledger, f"{routes.surrogate(name)}/ledger", body)

    def improve(
        self, name: str, queries: int, *, checkpoint: str | None = None, idempotency_key: str | None = None
    ) -> wire.ImprovedSurrogate:
        """Ask the design for more queries, weighted by the occupancy submitted under ``checkpoint``.

        Raises:
            BeyondBudget: the budget has not as many left, and this token may not raise it; one of role admin does.
        """
        body = wire.Improve(queries=queries, checkpoint=checkpoint, idempotency_key=idempotency_key or new_key())
        return self._post(wire.ImprovedSurrogate, f"{routes.surrogate(name)}/improve", body)

    # Models

    def session_coordinates(self, session: str) -> list[list[float]]:
        """Where each lane of a session is, (N, C)."""
        return self._get(wire.SessionCoordinates, f"{routes.session(session)}/coordinates").coordinates

    def query_uncertainty(
        self,
        name: str,
        coordinates: Sequence[Sequence[float]],
        action: Sequence[Sequence[float]],
        *,
        model: int | None = None,
    ) -> wire.Uncertainty:
        """Mean, deviation and uncertainty index at coordinates (n, C) and action (n, F)."""
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
        """One transition each from coordinates (n, C) under action (n, F)."""
        return self._of_points(wire.Prediction, f"{routes.surrogate(name)}/predict", coordinates, action, model)

    def models(self, name: str) -> list[wire.ModelView]:
        """Every fit with its structure, hyperparameters and fidelity, oldest first."""
        return self._get(wire.ModelList, f"{routes.surrogate(name)}/models").models

    def model(self, name: str) -> wire.ModelView:
        """The latest model's structure and fidelity. Raises ``NoModel`` before the first fit."""
        view = self.surrogate(name)
        if view.model_version is None:
            detail = f"{name!r} has no model yet: let a sampler answer its first queries, or import a log"
            raise NoModel(Problem(title="No model", status=STATUS[Code.NO_MODEL], code=Code.NO_MODEL, detail=detail))
        return self._get(wire.ModelView, f"{routes.surrogate(name)}/models/{view.model_version}")

    def export_model(self, name: str, version: int) -> bytes:
        """The model itself, complete, as a safetensors file."""
        route = f"{routes.surrogate(name)}/models/{version}"
        return self.connection.send("GET", route, params={"format": "safetensors"})

    def import_model(self, name: str, data: bytes) -> wire.ModelView:
        """Make an exported model the newest version of a surrogate with the same outputs."""
        route = f"{routes.surrogate(name)}/models"
        reply = self.connection.send("POST", route, data, media_type=_MODEL_FILE, repeatable=False)
        return parse(wire.ModelView, reply, route)

    # Policies

    @property
    def policies(self) -> PolicyCalls:
        """Policies of surrogates: store, list, give out, evaluate, name."""
        return PolicyCalls(self.connection)

    # Events

    def events(self, name: str, after: int | None = None) -> Iterator[wire.Event]:
        """Follow what happens to a surrogate, for ever; a broken stream goes on after the last event seen.

        Args:
            name: the surrogate.
            after: id of the last event already known; None starts with what happens from now on.

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
        """Events of one connection; None for a sign of life. Ends only by an error."""
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
        raise ServerUnreachable(f"the server at {self.url} ended the stream of events")

    def _of_points(
        self,
        reply: type[P],
        path: str,
        coordinates: Sequence[Sequence[float]],
        action: Sequence[Sequence[float]],
        model: int | None,
    ) -> P:
        """What one model says of any number of points, in requests of a size that the server takes."""
        if len(coordinates) != len(action):
            raise ValueError(f"expected an action for each of {len(coordinates)} points, got {len(action)}")
        parts: list[P] = []
        size = max(1, _NUMBERS // max(1, len([*coordinates[0], *action[0]]))) if coordinates else 1
        for start in range(0, len(coordinates), size) or [0]:
            rows = slice(start, start + size)
            body = wire.Points(
                coordinates=[list(row) for row in coordinates[rows]],
                action=[list(row) for row in action[rows]],
                model=parts[0].model_version if parts else model,
            )
            parts.append(self._post(reply, path, body))
        by_point = {
            field: [row for part in parts for row in getattr(part, field)]
            for field in reply.model_fields
            if field not in _OF_ALL_POINTS
        }
        return parts[0].model_copy(update=by_point)

    def _get(self, reply: type[R], path: str, **params: str | int) -> R:
        return parse(reply, self.connection.send("GET", path, params=params or None), path)

    def _post(self, reply: type[R], path: str, body: BaseModel, *, method: str = "POST", **options: Any) -> R:
        return parse(reply, self._send(path, body, method=method, **options), path)

    def _send(self, path: str, body: BaseModel, *, method: str = "POST", **options: Any) -> bytes:
        return self.connection.send(method, path, body.model_dump_json().encode(), **options)


def new_key() -> str:
    """A fresh idempotency key."""
    return uuid4().hex


def check_protocol(protocol: int, url: str) -> None:
    """Refuse a server of another protocol version."""
    if protocol != wire.PROTOCOL:
        raise ProtocolMismatch(f"expected protocol {wire.PROTOCOL} at {url}, got {protocol}: upgrade the older side")


def _batches(samples: Sequence[wire.NewSample]) -> list[list[wire.NewSample]]:
    """The samples in requests of at most ``_BATCH_BYTES``; one batch, perhaps an empty one, at least."""
    batches: list[list[wire.NewSample]] = [[]]
    room = _BATCH_BYTES
    for sample in samples:
        size = len(sample.model_dump_json()) + 1
        if size > room and batches[-1]:
            batches.append([])
            room = _BATCH_BYTES
        batches[-1].append(sample)
        room -= size
    return batches
