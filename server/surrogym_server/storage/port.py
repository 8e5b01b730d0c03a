"""The storage port: all data that the server keeps. Its docstrings are invariants, by which every adapter is tested.

For all of it:
- an operation is atomic, and what it changed is durable when it returns;
- any thread may call, and on PostgreSQL any number of servers;
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

from surrogym_server.storage.announcements import Announcements
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
LATEST = "latest"  # the alias of the newest policy

T = TypeVar("T")


class Surrogates(ABC):
    """Part of the storage for surrogates, which are identified by name."""

    @abstractmethod
    def create(self, new: NewSurrogate) -> tuple[SurrogateRecord, bool]:
        """Create a surrogate in phase ``collecting`` with its initial queries, and return whether it is new.

        Many queries are queued in several transactions, so that they block no writer for long. No fit is due before
        all are there. If a crash interrupts the call, ``Designs.unbegun`` returns the surrogate, and ``ask_first``
        queues the missing queries.

        If the name is taken, return the existing surrogate unchanged, and False. The caller checks whether its
        specification is the same.
        """

    @abstractmethod
    def get(self, name: str) -> SurrogateRecord: ...

    @abstractmethod
    def standing(self, name: str) -> Standing:
        """Return the fields of a surrogate that every claim and answer reads. Raises ``UnknownSurrogate``."""

    @abstractmethod
    def name_of(self, id: int) -> str:
        """Return the name of a surrogate by its id. Raises ``UnknownSurrogate`` if it was deleted."""

    @abstractmethod
    def summary(self, name: str) -> SurrogateSummary: ...

    @abstractmethod
    def summaries(self, after: int = 0, limit: int | None = None) -> list[SurrogateSummary]:
        """Return up to ``limit`` surrogates with an id above ``after``, oldest first.

        The number of statements does not depend on the number of surrogates. No model is loaded, and of a specification
        only the environment's name is parsed.
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
        """Change the fields that are not None; of ``tolerances`` those of the named outputs.

        A tolerance of None returns that output to its default. Another budget, target or tolerance, or resuming a
        failed design, makes a fit due. Resuming (``paused`` False, even if it was not paused) retries the queries that
        were set aside, each with ``MAX_ATTEMPTS`` more.

        Queries that the design chose by another target or tolerance, or by a larger budget, are withdrawn if no sampler
        has begun them. A running fit loses its right, and the next fit judges and chooses anew. Queries added by
        ``improve`` are chosen again, unless the budget is smaller. Initial queries are withdrawn only if they exceed
        the budget.
        """

    @abstractmethod
    def set_phase(self, name: str, phase: Phase, error: str | None = None) -> None: ...

    @abstractmethod
    def delete(self, name: str) -> None:
        """Delete the surrogate and everything that belongs to it.

        Its name is free at once. Its rows are removed in transactions that block no writer for long.
        """

    @abstractmethod
    def complete_removals(self) -> int:
        """Complete the deletions that a crash has interrupted. Returns the number of surrogates concerned."""


class Designs(ABC):
    """Part of the storage for designs: at any time at most one server has the right to fit a surrogate."""

    @abstractmethod
    def improve(
        self,
        name: str,
        queries: int,
        *,
        checkpoint: str | None = None,
        key: str | None = None,
        raise_budget: bool = False,
    ) -> Granted:
        """Let the next fit add ``queries`` more, even if the design is ready. A fit becomes due.

        The number counts real steps: a rollout has as many as actions.

        Args:
            raise_budget: raise the budget by the steps that are not ``left``.

        Raises:
            BeyondBudget: the budget has fewer steps left, and may not be raised.
        """

    @abstractmethod
    def left(self, name: str) -> int:
        """Return the number of real steps that the budget has left.

        Steps that were taken, that unanswered queries (open or set aside) need, or that ``improve`` has promised are
        subtracted. The result is 0 if they exceed the budget.
        """

    @abstractmethod
    def due(self) -> list[str]:
        """Return the names of the surrogates to fit now, oldest first.

        Such a surrogate has samples, no pending or leased query, and a change since its last fit (a sample, a query set
        aside, an ``improve``, another budget or target, a damaged model). After a log has been imported, it does not
        wait for queries. It is not paused, and no server holds the right to fit. A right with more time left than it
        was given, because the clock was set back, counts as free.
        """

    @abstractmethod
    def hopeless(self) -> list[str]:
        """Return the names of surrogates that can't continue, oldest first.

        Such a surrogate is collecting and not paused, has neither samples nor open queries, and its queries were set
        aside. So there is nothing to fit, and nothing to wait for.
        """

    @abstractmethod
    def unbegun(self) -> list[str]:
        """Return the names of surrogates whose design lacks initial queries, oldest first.

        Such a surrogate has a budget but never had a query, is collecting and not paused, and has no samples: it was
        created with a budget of 0. Or a crash has interrupted ``Surrogates.create`` a minute ago or earlier.
        """

    @abstractmethod
    def ask_first(self, name: str, queries: Sequence[Query]) -> None:
        """Queue the missing initial queries of a surrogate that ``unbegun`` returned; none if none are missing."""

    @abstractmethod
    def begin(self, name: str, owner: str, seconds: float) -> FitLease | None:
        """Take the right to fit. The phase becomes ``fitting``. Returns None if the surrogate is not due."""

    @abstractmethod
    def renew(self, lease: FitLease, seconds: float) -> FitLease:
        """Extend the right to ``seconds`` from now. A right that has expired, and that no server has taken since, is
        valid again.

        Raises:
            LeaseExpired: another server has taken the right since.
        """

    @abstractmethod
    def commit(self, lease: FitLease, design: NewDesign) -> int:
        """Store model, state, phase and next queries together, and release the right. Returns the model's version.

        The error is cleared. Queries get the new round and purpose ``adaptive``. Samples that arrived since ``begin``
        make the next fit due.

        Raises:
            LeaseExpired: another server has taken the right since.
        """

    @abstractmethod
    def abort(self, lease: FitLease, error: str | None) -> None:
        """Release the right without a model. Harmless if the right is gone.

        With an error, the phase becomes ``failed``, and the next fit is due once something changes. Without one (a
        shutdown), the fit stays due.
        """


class Queries(ABC):
    """The queue of queries and their leases.

    A query is pending, leased, answered, set_aside or refused. A lease that fails or expires makes it pending again;
    after ``MAX_ATTEMPTS`` it is set aside. A query that is returned before a real step does not count as an attempt.
    One that the original environment refuses is not claimed again, and does not count towards the budget.
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
        """Queue queries by hand, or of an audit, and return their ids.

        Raises:
            BeyondBudget: all audits of the surrogate together would have more steps than its budget, and more than 128.
        """

    @abstractmethod
    def claim(self, name: str, sampler: str, limit: int, seconds: float) -> list[LeasedQuery]:
        """Lease up to ``limit`` pending queries for ``seconds``, oldest first, each to one caller only.

        Expired leases are ended first. A paused surrogate gives out no queries.
        """

    @abstractmethod
    def renew(self, name: str, query_id: int, token: str, seconds: float) -> float:
        """Extend the lease to ``seconds`` from now, and return its end.

        Raises:
            UnknownQuery, ForeignLease: as the class says.
            LeaseExpired: the lease has ended, by its time, an answer or a failure.
        """

    @abstractmethod
    def fail(
        self, name: str, query_id: int, token: str, error: str, *, begun: bool = True, refused: bool = False
    ) -> QueryRecord:
        """End the lease with an error. The query becomes pending again, or is set aside. A repeat is harmless.

        ``begun`` says that a real step may have been taken, so that the ledger counts it as unresolved. ``refused``
        says that the original environment refused the query before a real step, whatever ``begun`` says. A query that
        begins at a snapshot which was dropped meanwhile is then removed, or set aside if a step may have been taken.

        Raises:
            UnknownQuery: there is no such query.
            ForeignLease: the token was never given out for this query.
            LeaseExpired: the lease ended by its time or an answer.
        """

    @abstractmethod
    def withdraw(self, name: str, query_ids: Sequence[int]) -> int:
        """Remove the given queries that are pending and that no sampler has begun. Returns how many were removed."""

    @abstractmethod
    def get(self, name: str, query_id: int) -> QueryRecord:
        """Return a query. Raises ``UnknownQuery`` if it does not exist."""

    @abstractmethod
    def list(self, name: str, statuses: Sequence[QueryStatus] = (), limit: int = 10_000) -> list[QueryRecord]:
        """Return the queries with one of the ``statuses``, oldest first; all queries if ``statuses`` is empty."""

    @abstractmethod
    def counts(self, name: str) -> QueryCounts: ...

    @abstractmethod
    def sweep_expired(self) -> int:
        """End the expired leases of all surrogates, and return how many there were.

        A lease with more time left than it was given, because the clock was set back, gets that time from now.
        """


class Samples(ABC):
    """Samples, which are never changed, and never lost once acknowledged."""

    @abstractmethod
    def add(
        self,
        name: str,
        sampler: str,
        samples: Sequence[NewSample],
        *,
        key: str | None = None,
        log: LogPart | None = None,
    ) -> AddedSamples:
        """Store a batch of samples, all or nothing, and answer the queries that it names. It is committed when this
        returns.

        A sample takes the purpose of its query, or ``manual``. Under a lease that has ended (by its time or a failure)
        it is kept and flagged late. It still answers the query unless another lease of the query is live. Each lease
        has one answer: a sample, or the first samples of a rollout, with ``step`` 0, 1, ... up to the query's
        ``steps``. Sending it again is a duplicate and gets the same id.

        Samples of a ``log`` answer no query, and don't count towards the budget. Each is identified by its numbers and
        by all samples of its log before it. So a log that comes again, or has grown, adds only what is new. Equal steps
        of one log all count, and those of two logs too. A log that differs from a stored one in a later part has to
        restart, see ``AddedSamples``. Until a log is complete, its samples make no fit due.

        Raises:
            UnknownQuery: there is no such query.
            ForeignLease: a lease token is missing, or was never given out for the query.
            InvalidInput: a logged sample names a query, or an answer lacks a step or has more steps than the query.
            IdempotencyConflict: the same lease token, or key, came with another sample.
        """

    @abstractmethod
    def arrays(self, name: str) -> RealSteps:
        """Return all samples, in order of arrival; (0, 0) arrays while there are none."""

    @abstractmethod
    def page(self, name: str, after: int, limit: int) -> list[SampleRecord]:
        """Return up to ``limit`` samples with an id above ``after``, in order."""

    @abstractmethod
    def count(self, name: str) -> int: ...

    @abstractmethod
    def reward_range(self, name: str) -> tuple[float, float] | None:
        """Return the smallest and the largest reward; None without samples."""


class Snapshots(ABC):
    """Part of the storage for the names of snapshots that samplers keep. ``Samples.add`` adds new names."""

    @abstractmethod
    def all(self, name: str) -> dict[str, Vector]:
        """Return the coordinates (C,) of each snapshot, by its name, oldest first."""

    @abstractmethod
    def drop(self, name: str, snapshots: Sequence[str]) -> int:
        """Forget snapshots, and return how many were known. Unknown names are skipped.

        Pending queries that begin there are removed, and a fit becomes due, which chooses anew. Queries of which a
        sampler may have taken steps are set aside instead.
        """


class Ledger(ABC):
    """Part of the storage that counts real steps by purpose."""

    @abstractmethod
    def report(self, name: str, steps: int, *, key: str, episodes: int = 0, note: str = "") -> LedgerRecord:
        """Count evaluation steps, once per key, and return the updated ledger."""

    @abstractmethod
    def read(self, name: str) -> LedgerRecord: ...


class Models(ABC):
    """Part of the storage for models, with versions 1, 2, ... The version None means the latest undamaged one."""

    @abstractmethod
    def list(self, name: str) -> list[ModelRecord]:
        """Return all models of a surrogate, oldest first."""

    @abstractmethod
    def get(self, name: str, version: int | None = None) -> ModelRecord:
        """Return a model's record.

        Raises:
            UnknownModel: there is no such version.
            NoModel: there is no model at all.
        """

    @abstractmethod
    def newest(self) -> dict[int, int]:
        """Return the newest version that is not set aside, for each surrogate that has one, by the surrogate's id."""

    @abstractmethod
    def blob(self, name: str, version: int | None = None) -> bytes:
        """Return the stored bytes of a model. Raises as ``get``.

        Raises:
            Damaged: the bytes differ from those that were stored.
        """

    @abstractmethod
    def set_aside(self, name: str, version: int, damage: str) -> bool:
        """Mark a version as damaged. The version before it becomes the newest, and a fit becomes due.

        Returns True unless the version was marked before. Version numbers are never used again.
        """

    @abstractmethod
    def add(self, name: str, model: NewModel) -> int:
        """Store an imported model as the newest version, and return its version number. The design is not changed."""


class Priors(ABC):
    """Part of the storage for priors: models of what is known of an environment beforehand, such as of a simulator.

    Each surrogate has at most one. While its design waits for a prior, no fit is due.
    """

    @abstractmethod
    def get(self, name: str) -> PriorRecord | None:
        """Return the description of the prior, also of one that is awaited; None if there is none."""

    @abstractmethod
    def blob(self, name: str) -> bytes | None:
        """Return the prior's model; None if there is none yet. Raises ``Damaged`` if it has changed since then."""

    @abstractmethod
    def put(self, name: str, blob: bytes, about: JSON) -> None:
        """Store a prior in place of any other. Queries that no sampler has begun are withdrawn, and a fit is due."""

    @abstractmethod
    def wait(self, name: str) -> None:
        """Let the design wait for a prior. If there is one, nothing changes."""

    @abstractmethod
    def drop(self, name: str) -> bool:
        """Remove the prior, or stop waiting for it, and return whether there was one. A fit without it is due."""


class Occupancy(ABC):
    """Part of the storage for occupancies: the states that policies visited, by training checkpoint."""

    @abstractmethod
    def put(self, name: str, checkpoint: str, states: Array) -> None:
        """Store states (m, C) under a checkpoint. Storing the same checkpoint again replaces them and makes them the
        latest."""

    @abstractmethod
    def get(self, name: str, checkpoint: str) -> OccupancyRecord | None:
        """Return the occupancy of a checkpoint; None if none is stored."""

    @abstractmethod
    def latest(self, name: str) -> OccupancyRecord | None:
        """Return the occupancy that was stored last; None if none is stored."""


class Sessions(ABC):
    """Part of the storage for sessions that a clean shutdown saves for the next start."""

    @abstractmethod
    def save(self, sessions: Sequence[SavedSession]) -> None:
        """Store sessions. One with the same id is replaced."""

    @abstractmethod
    def take(self) -> list[SavedSession]:
        """Return all saved sessions and remove them from the storage, so that each is restored once."""


class Events(ABC):
    """Part of the storage for events of surrogates.

    Every change that may end a wait appends an event: a claim that waits for queries or jobs looks again after each
    event.
    """

    @abstractmethod
    def newest(self, names: Sequence[str]) -> dict[str, int]:
        """Return the id of each surrogate's newest event, 0 before the first. Surrogates that do not exist are left
        out.

        It takes one statement, whose cost does not depend on the number of events.
        """

    @abstractmethod
    def prune(self, keep: int) -> int:
        """Remove all but the newest ``keep`` events of each surrogate. Returns the number of events removed.

        Surrogates without a new event since the last call are skipped. Each transaction removes a few events only, so
        that it blocks no writer for long.
        """

    @abstractmethod
    def list(self, name: str, after: int = 0, limit: int = 1_000) -> list[EventRecord]:
        """Return up to ``limit`` events with an id above ``after``, in order."""


class PolicyNames(ABC):
    """Versions and aliases of policies, which several features read. The feature ``policies`` stores them."""

    @abstractmethod
    def version(self, name: str, which: str) -> int:
        """Return the version that ``which`` names: a number, an alias, or ``latest``. Raises ``UnknownPolicy``."""

    @abstractmethod
    def has_evaluation(self, name: str, version: int, id: int) -> bool:
        """Return whether a policy version has this evaluation. Raises ``UnknownPolicy`` if there is no such version."""


class Storage(ABC):
    """The whole storage, by its parts. ``open_storage`` of an adapter makes one."""

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
        """Return the store of a feature, made by calling ``store`` with the adapter's database."""

    @abstractmethod
    def ping(self) -> None:
        """Check that all tables exist and that the database accepts writes. Frequent calls cost little.

        Raises:
            Unavailable: the check fails, or a write takes longer than a caller should wait.
        """

    @abstractmethod
    def close(self) -> None:
        """Release connections and locks. Closing twice is harmless."""
