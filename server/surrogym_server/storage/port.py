"""Interface of the storage of all data. Its docstrings are invariants, by which each implementation is tested.

For all methods:
- an operation is atomic, and its changes are durable when it returns;
- all methods are thread-safe, and on PostgreSQL any number of servers may call them at a time;
- time is the database's clock, and a lease ends by that clock alone, whichever process dies; if the clock is set back,
  no lease lasts longer than its duration;
- an operation on a surrogate that does not exist raises ``UnknownSurrogate``;
- an operation that raises has changed nothing;
- a repeat with the same idempotency ``key`` and the same arguments changes nothing and returns the first result;
  with other arguments it raises ``IdempotencyConflict``;
- a database that can't be reached raises ``Unavailable``;
- stored data that differ from what was written raise ``Damaged``, which names them;
- events are appended by the operations themselves; their ids increase in the order in which they become visible.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from surrogym_server.storage.records import (
    JSON,
    AddedSamples,
    Array,
    EventRecord,
    FitLease,
    Granted,
    LeasedQuery,
    LedgerRecord,
    LogPart,
    ModelRecord,
    NewDesign,
    NewModel,
    NewSample,
    NewSurrogate,
    OccupancyRecord,
    PriorRecord,
    QueryCounts,
    QueryRecord,
    SampleRecord,
    SavedSession,
    Standing,
    SurrogateRecord,
    SurrogateSummary,
)
from surrogym_shared.nouns import Query, RealSteps, Vector
from surrogym_shared.states import Phase, Purpose, QueryStatus

MAX_ATTEMPTS = 3
LATEST = "latest"  # reserved alias of the newest policy

T = TypeVar("T")


class Surrogates(ABC):
    """Part of the storage interface for surrogates, which are identified by name."""

    @abstractmethod
    def create(self, new: NewSurrogate) -> tuple[SurrogateRecord, bool]:
        """Create a surrogate in phase ``collecting`` with its initial queries. Return it, and whether it is new.

        Many queries are queued in several transactions, so that other writers wait only briefly. No fit is due before
        all are queued. If a crash interrupts the call, ``Designs.unbegun`` returns the surrogate, and
        ``Designs.ask_first`` queues the missing queries.

        If a surrogate of this name exists, it is returned unchanged, with False. The caller has to compare the
        specifications.
        """

    @abstractmethod
    def get(self, name: str) -> SurrogateRecord: ...

    @abstractmethod
    def standing(self, name: str) -> Standing:
        """Return the fields of a surrogate that frequent requests read: its id, its phase, and whether it is paused.
        Raises ``UnknownSurrogate``."""

    @abstractmethod
    def name_of(self, id: int) -> str:
        """Return the name of a surrogate by its id. Raises ``UnknownSurrogate`` if it was deleted."""

    @abstractmethod
    def summary(self, name: str) -> SurrogateSummary: ...

    @abstractmethod
    def summaries(self, after: int = 0, limit: int | None = None) -> list[SurrogateSummary]:
        """Return summaries of up to ``limit`` surrogates with an id above ``after``, oldest first.

        The number of SQL statements does not depend on the number of surrogates. No model is loaded, and only the
        environment's name is parsed from a specification.
        """

    @abstractmethod
    def change(
        self,
        name: str,
        *,
        paused: bool | None = None,
        budget: int | None = None,
        target: float | None = None,
        tolerances: dict[str, float | None] | None = None,
    ) -> SurrogateRecord:
        """Change the fields of a surrogate that are given (not None), and return its record.

        ``tolerances`` are by output; None for an output restores its default. Another budget, target or tolerance, or
        resuming a failed design, makes a fit due. ``paused`` False, even if the surrogate was not paused, retries the
        queries that were set aside or refused, each with ``MAX_ATTEMPTS`` more attempts.

        After a change of target or tolerance, or a lower budget, adaptive queries without a real step so far are
        withdrawn, a running fit loses its lease, and the next fit chooses new queries. Queries requested by ``improve``
        are chosen again, unless the budget is lower. Initial queries are withdrawn only if they exceed the budget.
        """

    @abstractmethod
    def set_phase(self, name: str, phase: Phase, error: str | None = None) -> None: ...

    @abstractmethod
    def delete(self, name: str) -> None:
        """Delete a surrogate and all its data.

        Its name can be used again at once. Its rows are removed in several transactions, so that other writers wait
        only briefly.
        """

    @abstractmethod
    def complete_removals(self) -> int:
        """Complete deletions of surrogates that a crash has interrupted, and return their number."""


class Designs(ABC):
    """Part of the storage interface for designs. A server fits a model only while it holds the surrogate's lease for
    fits, which one server holds at a time."""

    @abstractmethod
    def improve(
        self,
        name: str,
        queries: int | Query,
        *,
        checkpoint: str | None = None,
        key: str | None = None,
        raise_budget: bool = False,
    ) -> Granted:
        """Request that the next fit chooses further queries, even if the design has ended. A fit becomes due.

        Args:
            name: name of the surrogate.
            queries: number of real steps of these queries; or a query in which a policy acts, which is stored at once.
            checkpoint: name of the occupancy that weights the choice; None for no weights.
            key: idempotency key of the request.
            raise_budget: whether to raise the budget by the missing steps.

        Raises:
            BeyondBudget: the budget has fewer steps left, and ``raise_budget`` is False.
        """

    @abstractmethod
    def left(self, name: str) -> int:
        """Return the number of real steps that a surrogate's budget has left, at least 0.

        It is the budget minus the steps taken, the steps of unanswered queries (open or set aside), and the steps
        requested by ``improve`` and not chosen yet.
        """

    @abstractmethod
    def due(self) -> list[str]:
        """Return the names of the surrogates that have to be fitted now, oldest first.

        Such a surrogate has samples, no pending or leased query, and a change since its last fit (a sample, a query set
        aside, an ``improve``, another budget or target, a damaged model). After the import of a log, it may have
        pending or leased queries. It is not paused, does not wait for a prior, and no server holds the lease of its
        fit. A lease with more time left than its duration, because the clock was set back, counts as expired.
        """

    @abstractmethod
    def hopeless(self) -> list[str]:
        """Return the names of surrogates whose design can't continue, oldest first.

        Such a surrogate is in phase ``collecting`` and not paused. It has no samples, and all its queries were refused
        by the environment, or set aside after repeated failures.
        """

    @abstractmethod
    def unbegun(self) -> list[str]:
        """Return the names of surrogates whose initial queries are missing, oldest first.

        There are two kinds. The first was created with a budget of 0 and has a larger budget now; it has no query or
        sample, is in phase ``collecting``, and is not paused. For the second, a crash interrupted ``Surrogates.create``
        at least a minute ago.
        """

    @abstractmethod
    def ask_first(self, name: str, queries: Sequence[Query]) -> None:
        """Queue the missing initial queries of a surrogate, given all its initial queries. Does nothing if none is
        missing."""

    @abstractmethod
    def begin(self, name: str, owner: str, seconds: float) -> FitLease | None:
        """Lease the fit of a surrogate to the server ``owner`` for ``seconds``; the phase becomes ``fitting``.

        Returns None if the surrogate is not due.
        """

    @abstractmethod
    def renew(self, lease: FitLease, seconds: float) -> FitLease:
        """Extend the lease of a fit to ``seconds`` from now, even if it has expired but no other server has taken it.

        Raises:
            LeaseExpired: another server has taken the lease, or it was withdrawn.
        """

    @abstractmethod
    def commit(self, lease: FitLease, design: NewDesign) -> int:
        """Store the result of a fit (model, state, phase, next queries), and end its lease. Return the model's version.

        The error of the design is cleared. The queries get the number of this round and the purpose ``adaptive``.
        Samples that arrived after ``begin`` make the next fit due.

        Raises:
            LeaseExpired: another server has taken the lease, or it was withdrawn.
        """

    @abstractmethod
    def abort(self, lease: FitLease, error: str | None) -> None:
        """End the lease of a fit without a result. Does nothing if the lease has ended.

        With an ``error``, the phase becomes ``failed``, and the next fit is due once the surrogate has changed since
        this fit began. With None, as at a shutdown, the fit stays due.
        """


class Queries(ABC):
    """Part of the storage interface for queries and their leases.

    A query is pending, leased, answered, set_aside or refused. If its lease fails or expires, it becomes pending again;
    after ``MAX_ATTEMPTS`` attempts it is set aside. A lease that ended before a real step does not count as an attempt.
    A query that the original environment refused is not leased again, and does not count towards the budget.
    """

    @abstractmethod
    def enqueue(
        self,
        name: str,
        new_queries: Sequence[Query],
        *,
        purpose: Purpose = "manual",
        key: str | None = None,
    ) -> list[int]:
        """Queue queries that a person or an audit (``purpose``) chose, and return their ids.

        Raises:
            BeyondBudget: all audits of the surrogate together would have more steps than its budget, and more than 128.
        """

    @abstractmethod
    def claim(self, name: str, sampler: str, limit: int, seconds: float) -> list[LeasedQuery]:
        """Lease up to ``limit`` pending queries to a sampler for ``seconds``, oldest first.

        First, expired leases are ended. If the surrogate is paused, the result is empty.
        """

    @abstractmethod
    def renew(self, name: str, query_id: int, token: str, seconds: float) -> float:
        """Extend the lease of a query to ``seconds`` from now, and return the time of its end.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: the token is not that of a lease of this query.
            LeaseExpired: the lease has expired, or ended with an answer or a failure.
        """

    @abstractmethod
    def fail(
        self, name: str, query_id: int, token: str, error: str, *, begun: bool = True, refused: bool = False
    ) -> QueryRecord:
        """End the lease of a query that could not be answered. The query becomes pending again. After its last attempt
        it is set aside: it is kept, but not leased again. A refused query is not leased again either.

        A repeat changes nothing. If the query begins at a snapshot that was dropped during the lease, the query is
        removed, or set aside if a step may have been taken.

        Args:
            name: name of the surrogate.
            query_id: id of the query.
            token: token of the lease.
            error: description of the failure.
            begun: whether a real step may have been taken. If so, the ledger counts the steps of the query as
                unresolved.
            refused: whether the original environment refused the query before a real step; ``begun`` is then ignored.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: the token is not that of a lease of this query.
            LeaseExpired: the lease has expired, or ended with an answer.
        """

    @abstractmethod
    def withdraw(self, name: str, query_ids: Sequence[int]) -> int:
        """Remove queries, given by their ids, and return the number removed. A query stays if it is not pending, or if
        a real step of it may have been taken."""

    @abstractmethod
    def get(self, name: str, query_id: int) -> QueryRecord:
        """Return the record of a query. Raises ``UnknownQuery`` if the surrogate has no such query."""

    @abstractmethod
    def list(self, name: str, statuses: Sequence[QueryStatus] = (), limit: int = 10_000) -> list[QueryRecord]:
        """Return up to ``limit`` queries with one of the ``statuses`` (empty: any status), oldest first."""

    @abstractmethod
    def counts(self, name: str) -> QueryCounts: ...

    @abstractmethod
    def sweep_expired(self) -> int:
        """End the expired leases of all surrogates, and return their number.

        A lease with more time left than its duration, because the clock was set back, is shortened to its duration.
        """


class Samples(ABC):
    """Part of the storage interface for samples, which are never changed, and never lost after ``add`` has returned."""

    @abstractmethod
    def add(
        self,
        name: str,
        sampler: str,
        samples: Sequence[NewSample],
        *,
        key: str | None = None,
        log: LogPart | None = None,
        at_bound: Sequence[bool] = (),
    ) -> AddedSamples:
        """Store a batch of samples, all or none, and mark the queries that they answer. Committed when this returns.

        A sample gets the purpose of its query, or ``manual`` without a query. If the lease of its query has expired or
        failed, the sample is stored and marked as late. It still answers the query, unless the query is leased again.

        All samples under one lease are one answer, and come in one batch. The answer to a query of one step is one
        sample. The answer to a rollout has the samples with ``step`` 0, 1, ..., without gaps; they may be fewer than
        the query's ``steps``. A repeat of an answer adds nothing and gets the same ids.

        Samples of a ``log`` answer no query, and don't count towards the budget. A logged sample is identified by its
        values and by all earlier samples of its log. So a repeated or extended log adds only its new samples, and equal
        steps within a log are all stored. If a log begins like a stored log and a later part differs, it has to be sent
        again from its start: see ``AddedSamples.restart``. A fit becomes due only after the last part of a log.

        ``at_bound`` (n,) says of each of the n samples whether an entry of its action was at a bound, which the ledger
        counts as wear; empty: of none. It is ignored for a log.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: a lease token is missing, or does not belong to the query.
            InvalidInput: a logged sample names a query, or an answer lacks a step or has more steps than the query.
            IdempotencyConflict: the same lease token or idempotency key came with other samples.
        """

    @abstractmethod
    def arrays(self, name: str) -> RealSteps:
        """Return all samples of a surrogate as arrays, in order of arrival; of shape (0, 0) if there are none."""

    @abstractmethod
    def page(self, name: str, after: int, limit: int) -> list[SampleRecord]:
        """Return up to ``limit`` samples with an id above ``after``, in order of their ids."""

    @abstractmethod
    def count(self, name: str) -> int: ...

    @abstractmethod
    def reward_range(self, name: str) -> tuple[float, float] | None:
        """Return the smallest and the largest reward of a surrogate's samples; None if there are no samples."""


class Snapshots(ABC):
    """Part of the storage interface for the names and coordinates of samplers' snapshots; ``Samples.add`` adds them."""

    @abstractmethod
    def all(self, name: str) -> dict[str, Vector]:
        """Return the coordinates (C,) of the state in each snapshot of a surrogate, by the snapshot's name, oldest
        first."""

    @abstractmethod
    def drop(self, name: str, snapshots: Sequence[str]) -> int:
        """Remove snapshots, and return the number removed. Unknown names are skipped.

        Pending queries that begin at a removed snapshot are removed too. If a real step may have been taken, they are
        set aside instead: they are kept, but not leased again. A fit becomes due, which chooses other queries.
        """


class Ledger(ABC):
    """Part of the storage interface that counts a surrogate's real steps by purpose."""

    @abstractmethod
    def report(self, name: str, steps: int, *, key: str, episodes: int = 0, note: str = "") -> LedgerRecord:
        """Add ``steps`` real steps of an evaluation of ``episodes`` episodes, once for each key. Return the counts of
        real steps by purpose. ``note`` is a text about the evaluation."""

    @abstractmethod
    def read(self, name: str) -> LedgerRecord: ...


class Models(ABC):
    """Part of the storage interface for models, which have versions 1, 2, ... As an argument, version None stands for
    the newest version that is not marked as damaged."""

    @abstractmethod
    def list(self, name: str) -> list[ModelRecord]:
        """Return the records of all models of a surrogate, oldest first."""

    @abstractmethod
    def get(self, name: str, version: int | None = None) -> ModelRecord:
        """Return the record of a model; of the newest undamaged one if ``version`` is None.

        Raises:
            UnknownModel: the surrogate has no model of this version.
            NoModel: ``version`` is None, and the surrogate has no undamaged model.
        """

    @abstractmethod
    def newest(self) -> dict[int, int]:
        """Return the newest undamaged model version of each surrogate that has one, by the surrogate's id."""

    @abstractmethod
    def blob(self, name: str, version: int | None = None) -> bytes:
        """Return the stored file of a model; of the newest undamaged one if ``version`` is None.

        Raises:
            UnknownModel, NoModel: there is no such model.
            Damaged: the file differs from the one that was stored.
        """

    @abstractmethod
    def set_aside(self, name: str, version: int, damage: str) -> bool:
        """Mark a model version as damaged, so that the version before it is used instead, and a fit becomes due.

        ``damage`` describes the damage. Returns False if the version was marked before. The number of the version is
        not used again.
        """

    @abstractmethod
    def add(self, name: str, model: NewModel) -> int:
        """Store an imported model as the newest version, and return its version. The design is not changed."""


class Priors(ABC):
    """Part of the storage interface for priors: models that are known before the first real step, such as of a
    simulator.

    Each surrogate has at most one prior. While its design waits for a prior, no fit is due.
    """

    @abstractmethod
    def get(self, name: str) -> PriorRecord | None:
        """Return the description of a surrogate's prior, also if the design still waits for it; None if there is
        none."""

    @abstractmethod
    def blob(self, name: str) -> bytes | None:
        """Return the file of a prior's model; None if it is not stored (yet).

        Raises ``Damaged`` if the file differs from the one that was stored.
        """

    @abstractmethod
    def put(self, name: str, blob: bytes, about: JSON) -> None:
        """Store a prior, which replaces an earlier one. ``blob`` is the file of its model, ``about`` its description.

        Adaptive queries without a real step so far are withdrawn, and a fit becomes due.
        """

    @abstractmethod
    def wait(self, name: str) -> None:
        """Let the design of a surrogate wait for a prior. Does nothing if it has one."""

    @abstractmethod
    def drop(self, name: str) -> bool:
        """Remove a surrogate's prior, or stop waiting for it. Return whether there was one. A fit becomes due."""


class Occupancy(ABC):
    """Part of the storage interface for occupancies: states that policies visited, by the name of a checkpoint."""

    @abstractmethod
    def put(self, name: str, checkpoint: str, states: Array) -> None:
        """Store visited states (m, C) under the name ``checkpoint``, as the latest occupancy. States that were stored
        under this name before are replaced."""

    @abstractmethod
    def get(self, name: str, checkpoint: str) -> OccupancyRecord | None:
        """Return the occupancy of a checkpoint; None if none is stored."""

    @abstractmethod
    def latest(self, name: str) -> OccupancyRecord | None:
        """Return the occupancy that was stored last; None if none is stored."""


class Sessions(ABC):
    """Part of the storage interface for sessions that a server saves at shutdown and restores at the next start."""

    @abstractmethod
    def save(self, sessions: Sequence[SavedSession]) -> None:
        """Store sessions. A stored session with the same id is replaced."""

    @abstractmethod
    def take(self) -> list[SavedSession]:
        """Return all saved sessions and remove them from the storage, so that each is restored once."""


class Events(ABC):
    """Part of the storage interface for events of surrogates.

    Each change that may end a wait appends an event, because a claim that waits for queries or jobs looks for them
    again after each event.
    """

    @abstractmethod
    def newest(self, names: Sequence[str]) -> dict[str, int]:
        """Return the id of each surrogate's newest event, by name; 0 if it has none. Unknown surrogates are left out.

        This takes one SQL statement, whose cost does not depend on the number of events.
        """

    @abstractmethod
    def prune(self, keep: int) -> int:
        """Remove all but the newest ``keep`` events of each surrogate. Return the number of events removed.

        Surrogates without a new event since the last call are skipped. Events are removed in many short transactions,
        so that other writers wait only briefly.
        """

    @abstractmethod
    def list(self, name: str, after: int = 0, limit: int = 1_000) -> list[EventRecord]:
        """Return up to ``limit`` events of a surrogate with an id above ``after``, in order of their ids."""


class PolicyNames(ABC):
    """Part of the storage interface that reads versions and aliases of policies, which several features need. The
    feature ``policies`` stores them."""

    @abstractmethod
    def version(self, name: str, which: str) -> int:
        """Return the policy version that ``which`` names: a number, an alias, or ``latest``. Raises
        ``UnknownPolicy``."""

    @abstractmethod
    def has_evaluation(self, name: str, version: int, id: int) -> bool:
        """Return whether a policy has an evaluation with this id. Raises ``UnknownPolicy`` if there is no such
        version."""


# Callback that gets the name of a changed surrogate, or None if announcements may have been lost.
Hear = Callable[[str | None], None]


class Announcements(ABC):
    """Messages between the servers of one database that a surrogate has changed. Thread-safe.

    A message may be lost, so a receiver also has to look for changed surrogates from time to time.
    """

    @abstractmethod
    def announce(self, surrogate: str) -> None:
        """Send to all other servers, soon, that a surrogate has changed. Returns at once, and never raises.

        Several unsent announcements of one surrogate are sent as one.
        """

    @abstractmethod
    def listen(self, hear: Hear) -> None:
        """Call ``hear``, in a thread, for each later announcement of another server. May be called once.

        After a lost connection is restored, ``hear`` is called with None, because announcements may have been lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop sending and listening. A second call does nothing."""


class Alone(Announcements):
    """Announcements for a database with a single server: nothing is sent or received."""

    def announce(self, surrogate: str) -> None:
        """Do nothing, because there is no other server."""

    def listen(self, hear: Hear) -> None:
        """Do nothing, because there is no other server that could send an announcement."""

    def close(self) -> None:
        """Do nothing, because nothing was opened."""


class Storage(ABC):
    """Interface of the whole storage, which consists of parts. ``open_storage`` creates an implementation."""

    surrogates: Surrogates
    designs: Designs
    queries: Queries
    samples: Samples
    snapshots: Snapshots
    ledger: Ledger
    models: Models
    priors: Priors
    occupancy: Occupancy
    sessions: Sessions
    events: Events
    policy_names: PolicyNames
    announcements: Announcements

    @abstractmethod
    def part(self, store: Callable[[Any], T]) -> T:
        """Create the store of an optional feature by calling ``store`` with the database of this storage."""

    @abstractmethod
    def ping(self) -> None:
        """Check that all tables exist and that the database accepts writes. The result is cached for a second.

        Raises:
            Unavailable: the check fails, or a write takes too long.
        """

    @abstractmethod
    def close(self) -> None:
        """Release connections and locks. A second call does nothing."""
