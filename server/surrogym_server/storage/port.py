"""The storage port: everything Surrogym remembers. Its docstrings are laws that every adapter is tested by.

For all of it:
- an operation is atomic, and what it changed is durable when it returns;
- any thread may call, and on PostgreSQL any number of servers;
- time is the database's clock, and a lease ends by that clock alone, whoever died; where the clock was set back, no
  lease lasts longer for it than it was given out for;
- an operation on a surrogate that is not there raises ``UnknownSurrogate``;
- an operation that raises has changed nothing;
- a repeat with the same idempotency ``key`` and the same arguments changes nothing and returns what the first
  returned; with other arguments it raises ``IdempotencyConflict``;
- a database that can't be reached raises ``Unavailable``;
- what is stored and can't be what was written raises ``Damaged``, which names it;
- events are appended by the operations themselves; their ids grow in the order in which they become visible.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from surrogym_server.storage.policies import Blobs, Policies
from surrogym_server.storage.records import (
    AddedSamples,
    Array,
    EventRecord,
    FitLease,
    Granted,
    LeasedQuery,
    LedgerRecord,
    ModelRecord,
    NewDesign,
    NewModel,
    NewSample,
    NewSurrogate,
    OccupancyRecord,
    Phase,
    Purpose,
    QueryCounts,
    QueryRecord,
    QueryStatus,
    SampleArrays,
    SampleRecord,
    SavedSession,
    SurrogateRecord,
    SurrogateSummary,
)

MAX_ATTEMPTS = 3


class Surrogates(ABC):
    """Surrogates by name."""

    @abstractmethod
    def create(self, new: NewSurrogate) -> tuple[SurrogateRecord, bool]:
        """Create a surrogate in phase ``collecting`` with its initial queries; says whether it is new.

        A name that is taken returns what is there, unchanged, and False; whether it is the same is for the caller.
        """

    @abstractmethod
    def get(self, name: str) -> SurrogateRecord: ...

    @abstractmethod
    def name_of(self, id: int) -> str:
        """Raises ``UnknownSurrogate`` when it was deleted."""

    @abstractmethod
    def summary(self, name: str) -> SurrogateSummary: ...

    @abstractmethod
    def summaries(self, after: int = 0, limit: int | None = None) -> list[SurrogateSummary]:
        """Up to ``limit`` surrogates with an id above ``after``, oldest first.

        The number of statements does not depend on the number of surrogates. No model is loaded, and no specification
        is parsed beyond the name of its environment.
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
        """Change what is not None; of ``tolerances`` those of the outputs named, of which None takes one back. Another
        budget, target or tolerance, or resuming a failed design, makes a fit due. Resuming (``paused`` False, even
        where it was not paused) asks the queries that were set aside again, each with ``MAX_ATTEMPTS`` more.

        What the design chose by another target or tolerance, or by a larger budget, is withdrawn as far as no sampler
        has begun it, and a fit that is running loses its right: the next one judges and chooses anew. What ``ask``
        asked for is asked for again, unless the budget is smaller; initial queries go only where they are beyond that.
        """

    @abstractmethod
    def set_phase(self, name: str, phase: Phase, error: str | None = None) -> None: ...

    @abstractmethod
    def delete(self, name: str) -> None:
        """Remove the surrogate and all that belongs to it."""


class Designs(ABC):
    """The right to fit: at any time at most one server fits a surrogate."""

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
        """Ask the next fit for ``queries`` more, whatever its verdict; a fit becomes due.

        Counted in real steps: a rollout's are as many as its actions.

        Args:
            raise_budget: raise the budget by what it has not ``left``.

        Raises:
            BeyondBudget: the budget has not as many left, and may not be raised.
        """

    @abstractmethod
    def left(self, name: str) -> int:
        """Real steps of the budget that are neither taken, nor asked for by a query without an answer (open or set
        aside), nor promised by ``ask``; 0 where there are more of these than the budget holds."""

    @abstractmethod
    def due(self) -> list[str]:
        """Names of the surrogates to fit now, oldest first.

        Such a surrogate has samples, no pending or leased query, and something new since its last fit
        (a sample, a query set aside, an ask, another budget or target, a damaged model). Where a log came in since,
        it does not wait for queries. It isn't paused, and
        nobody holds the right; one with more time left than it was given, as the clock was set back, is nobody's.
        """

    @abstractmethod
    def hopeless(self) -> list[str]:
        """Names of the surrogates that collect, are not paused, have neither samples nor open queries, and whose
        queries were set aside: there is nothing to fit, and nothing to wait for. Oldest first."""

    @abstractmethod
    def begin(self, name: str, owner: str, seconds: float) -> FitLease | None:
        """Take the right to fit; the phase becomes ``fitting``. None when the surrogate is not due."""

    @abstractmethod
    def renew(self, lease: FitLease, seconds: float) -> FitLease:
        """Hold the right until ``seconds`` from now.

        Raises:
            LeaseExpired: another has taken it since. One that ended unnoticed comes back to life.
        """

    @abstractmethod
    def commit(self, lease: FitLease, design: NewDesign) -> int:
        """Store model, state, phase and next queries together, and end the right; returns the version.

        The error is cleared. Queries get the new round and purpose ``adaptive``. What came in since ``begin``
        makes the next fit due.

        Raises:
            LeaseExpired: another has taken the right since.
        """

    @abstractmethod
    def abort(self, lease: FitLease, error: str | None) -> None:
        """End the right without a model; harmless when it is gone.

        With an error the phase becomes ``failed``, and the next fit is due when something new comes. Without
        one (a shutdown) the fit stays due.
        """


class Queries(ABC):
    """The queue of queries and their leases.

    A query is pending, leased, answered or set_aside. A lease that fails or expires makes it pending again,
    and the last of ``MAX_ATTEMPTS`` sets it aside. One that is given back unbegun is no attempt: no step was taken.
    """

    @abstractmethod
    def enqueue(
        self,
        name: str,
        coordinates: Array,
        action: Array,
        rollouts: Sequence[Array] = (),
        *,
        purpose: Purpose = "manual",
        key: str | None = None,
    ) -> list[int]:
        """Queue queries by hand, or of an audit: steps from coordinates (m, C) under action (m, F), and rollouts of
        action sequences, each (T, F); returns their ids.

        Raises:
            BeyondBudget: all audits of the surrogate together would have more steps than its budget, and than 64.
        """

    @abstractmethod
    def claim(self, name: str, sampler: str, limit: int, seconds: float) -> list[LeasedQuery]:
        """Lease up to ``limit`` pending queries for ``seconds``, oldest first, each to one caller only.

        Expired leases are swept first. A paused surrogate hands out nothing.
        """

    @abstractmethod
    def renew(self, name: str, query_id: int, token: str, seconds: float) -> float:
        """Let the lease end ``seconds`` from now; returns when.

        Raises:
            UnknownQuery, ForeignLease: as the class says.
            LeaseExpired: the lease has ended, by its time, an answer or a failure.
        """

    @abstractmethod
    def fail(self, name: str, query_id: int, token: str, error: str, *, begun: bool = True) -> QueryRecord:
        """End the lease with an error; the query goes to the next one or is set aside. A repeat is harmless.

        ``begun``: a real step may have been taken, so that the ledger counts it as unresolved.

        Raises:
            UnknownQuery: no such query.
            ForeignLease: the token was never given out for this query.
            LeaseExpired: the lease ended by its time or an answer.
        """

    @abstractmethod
    def withdraw(self, name: str, query_ids: Sequence[int]) -> int:
        """Remove those of these queries that are pending and that no sampler has begun; returns how many."""

    @abstractmethod
    def get(self, name: str, query_id: int) -> QueryRecord:
        """Raises ``UnknownQuery`` when there is none."""

    @abstractmethod
    def list(self, name: str, statuses: Sequence[QueryStatus] = (), limit: int = 10_000) -> list[QueryRecord]:
        """The queries of these statuses (none: all), oldest first."""

    @abstractmethod
    def counts(self, name: str) -> QueryCounts: ...

    @abstractmethod
    def sweep_expired(self) -> int:
        """End the leases whose time has come, of all surrogates; returns how many.

        One that has more time left than it was given has that time from now: the clock was set back.
        """


class Samples(ABC):
    """Samples: never changed, never lost once acknowledged."""

    @abstractmethod
    def add(
        self,
        name: str,
        sampler: str,
        samples: Sequence[NewSample],
        *,
        key: str | None = None,
        logged: bool = False,
        complete: bool = True,
    ) -> AddedSamples:
        """Store a batch, all or nothing, and answer the queries it names; committed when it returns.

        A sample takes the purpose of its query, or ``manual``. Under a lease that has ended (by its time or a
        failure) it is kept and flagged late; it still answers the query unless another lease of it is live.
        Under one lease there is one answer: a sample, or the first samples of a rollout, ``step`` 0, 1, ... up to the
        query's ``steps``. The same again is a duplicate and gets the same id.

        ``logged`` samples answer no query, and count apart from the budget. One that equals a logged sample of the
        surrogate in every number is a duplicate, whatever batch it came in. While a log is not ``complete``, no fit
        becomes due for what has come of it.

        Raises:
            UnknownQuery: no such query.
            ForeignLease: a lease token that was never given out for the query, or none.
            InvalidInput: a logged sample that names a query, or an answer that lacks a step or has more than the query
                asked for.
            IdempotencyConflict: the same lease token, or key, with another sample.
        """

    @abstractmethod
    def arrays(self, name: str) -> SampleArrays:
        """All samples, in order of arrival."""

    @abstractmethod
    def page(self, name: str, after: int, limit: int) -> list[SampleRecord]:
        """Up to ``limit`` samples with an id above ``after``, in order."""

    @abstractmethod
    def count(self, name: str) -> int: ...

    @abstractmethod
    def reward_range(self, name: str) -> tuple[float, float] | None:
        """The least and the largest reward; None without samples."""


class Ledger(ABC):
    """Real steps by purpose."""

    @abstractmethod
    def report(self, name: str, steps: int, *, key: str, episodes: int = 0, note: str = "") -> LedgerRecord:
        """Count evaluation steps, once per key; returns the ledger as it is now."""

    @abstractmethod
    def read(self, name: str) -> LedgerRecord: ...


class Models(ABC):
    """Models by version: 1, 2, ... of each surrogate. ``None`` is the latest that is not set aside."""

    @abstractmethod
    def list(self, name: str) -> list[ModelRecord]:
        """All of them, oldest first."""

    @abstractmethod
    def get(self, name: str, version: int | None = None) -> ModelRecord:
        """Raises ``UnknownModel`` for a version that is not there, ``NoModel`` when there is none at all."""

    @abstractmethod
    def newest(self) -> dict[int, int]:
        """The newest version that is not set aside of each surrogate that has one, by the surrogate's id."""

    @abstractmethod
    def blob(self, name: str, version: int | None = None) -> bytes:
        """The model itself, as it was given. Raises as ``get``.

        Raises:
            Damaged: it is no longer what was given.
        """

    @abstractmethod
    def set_aside(self, name: str, version: int, damage: str) -> bool:
        """Note that a version is damaged: the one before it is the newest then, and a fit becomes due.

        Says whether that was new; a repeat changes nothing, and no version's number is used again.
        """

    @abstractmethod
    def add(self, name: str, model: NewModel) -> int:
        """Import a model as the newest version; returns it. The design is not touched."""


class Occupancy(ABC):
    """States that policies visited, by checkpoint."""

    @abstractmethod
    def put(self, name: str, checkpoint: str, states: Array) -> None:
        """Store states (m, C) under a name; the same name again replaces them and makes them the latest."""

    @abstractmethod
    def get(self, name: str, checkpoint: str) -> OccupancyRecord | None: ...

    @abstractmethod
    def latest(self, name: str) -> OccupancyRecord | None: ...


class Sessions(ABC):
    """Sessions that a clean shutdown saves for the next start."""

    @abstractmethod
    def save(self, sessions: Sequence[SavedSession]) -> None:
        """Store them; the same id again replaces."""

    @abstractmethod
    def take(self) -> list[SavedSession]:
        """Return and remove them: each is given out once."""


class Events(ABC):
    """What happened to a surrogate."""

    @abstractmethod
    def list(self, name: str, after: int = 0, limit: int = 1_000) -> list[EventRecord]:
        """Up to ``limit`` events with an id above ``after``, in order."""


class Storage(ABC):
    """All of it. ``open_storage`` makes one."""

    surrogates: Surrogates
    designs: Designs
    queries: Queries
    samples: Samples
    ledger: Ledger
    models: Models
    occupancy: Occupancy
    sessions: Sessions
    events: Events
    policies: Policies
    blobs: Blobs

    @abstractmethod
    def ping(self) -> None:
        """Return when all tables are there and the database takes writes; costs a caller little, however often it asks.

        Raises:
            Unavailable: it does not, or a write takes longer than a caller should wait.
        """

    @abstractmethod
    def close(self) -> None:
        """Give up connections and locks; closing twice is harmless."""
