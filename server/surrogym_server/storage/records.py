"""Records of the storage: frozen dataclasses that depend neither on a database nor on wire types.

Shapes: C coordinates, F action entries, D observation entries. Times are seconds since 1970, on the database's clock.
``JSON`` is a value that ``json.dumps`` and ``json.loads`` return unchanged.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.nouns import Query, RealStep, Vector
from surrogym_shared.states import EventKind, Phase, Purpose, QueryStatus, SamplePurpose

Array = NDArray[np.float64]
JSON = dict[str, Any]
FREE = ("audit", "logged")  # purposes of samples that don't count towards the budget

OPEN_STATUSES: tuple[QueryStatus, ...] = ("pending", "leased")


# Surrogates and their design


@dataclass(frozen=True)
class NewSurrogate:
    """A surrogate to create, with its initial queries."""

    name: str
    spec: JSON
    budget: int
    target: float
    queries: Sequence[Query] = ()


@dataclass(frozen=True)
class Standing:
    """The fields of a surrogate that frequent requests read: its id, its phase, and whether it is paused."""

    id: int
    phase: Phase
    paused: bool


@dataclass(frozen=True)
class SurrogateRecord:
    id: int  # never used again after a deletion, unlike the name
    name: str
    spec: JSON
    budget: int
    target: float
    tolerances: dict[str, float]  # tolerances that were set after the surrogate's creation, by output
    phase: Phase
    paused: bool
    round: int  # number of rounds of the design so far
    state: JSON  # what the design keeps from one fit to the next, as ``DesignState.to_json`` returns it
    error: str | None
    extra_queries: int  # number of real steps that ``Designs.improve`` requested and no fit has chosen yet
    checkpoint: str | None  # name of the occupancy (visited states) that the last ``Designs.improve`` named, if any
    created_at: float


@dataclass(frozen=True)
class Granted:
    """Result of ``Designs.improve``, a request for more queries: the surrogate, and the increase of its budget."""

    record: SurrogateRecord  # the surrogate after the request
    raised: int  # increase of the budget, in real steps


@dataclass(frozen=True)
class FitLease:
    """Lease that allows one server to fit a surrogate's model. ``Designs`` begins, renews and ends it."""

    surrogate: str
    token: str
    revision: int  # revision (counter of changes) of the surrogate when the fit began
    extra_queries: int  # number of real steps that this fit has to choose even if the design has ended
    checkpoint: str | None
    expires: float


@dataclass(frozen=True)
class NewModel:
    samples: int
    data_hash: str
    fidelity: JSON
    description: JSON
    fit_seconds: float
    blob: bytes = field(repr=False)


@dataclass(frozen=True)
class ModelRecord:
    """Description of a stored model, without the model's file."""

    version: int  # number of the model among the surrogate's models: 1, 2, ...
    created_at: float
    samples: int
    data_hash: str
    fidelity: JSON
    description: JSON
    fit_seconds: float

    @property
    def tolerances(self) -> list[float]:
        """Tolerance of each output, in the output's unit."""
        return [output["tolerance"] for output in self.fidelity["outputs"]]


@dataclass(frozen=True)
class NewDesign:
    """Result of one fit: a model, the design's new state and phase, and the next queries."""

    model: NewModel
    state: JSON
    phase: Phase
    queries: tuple[Query, ...] = ()
    extra: bool = False  # whether the queries were only chosen because ``Designs.improve`` requested them


# Queries and samples


@dataclass(frozen=True, kw_only=True)
class QueryRecord(Query):
    """A stored query with its status, the number of its leases, and its last error."""

    id: int
    purpose: Purpose
    status: QueryStatus
    round: int
    attempts: int  # how often the query has been leased so far
    sampler: str | None  # name of the sampler that claimed the query last
    error: str | None  # error of the last lease that ended without an answer; None if there is none
    # Time left of the open lease, by the database's clock; negative after it has expired; None without an open lease.
    lease_seconds_left: float | None = None


@dataclass(frozen=True, kw_only=True)
class LeasedQuery(Query):
    """A query that is leased to a sampler, with its lease."""

    id: int
    number: int  # number of earlier queries of the same surrogate
    purpose: Purpose
    attempt: int  # number of this lease among the leases of the query: 1, 2, ...
    token: str
    expires: float


@dataclass(frozen=True)
class QueryCounts:
    pending: int = 0
    leased: int = 0
    answered: int = 0
    set_aside: int = 0
    refused: int = 0

    @property
    def open(self) -> int:
        return self.pending + self.leased


@dataclass(frozen=True)
class Sample(RealStep):
    """A real step that a sampler took, as tuples of floats; it may answer a query."""

    coordinates: Vector
    action: Vector
    next_coordinates: Vector
    observation: Vector | None = None
    next_observation: Vector | None = None
    query_id: int | None = None
    step: int = 0  # index of this step in the answer to a rollout; 0 for a single step
    seconds: float | None = None  # since the end of the step before in the same rollout; None if not measured


@dataclass(frozen=True)
class NewSample(Sample):
    """A sample that a sampler reports. ``query_id`` and ``lease_token`` are both present or both absent."""

    lease_token: str | None = None
    snapshot: str | None = None  # name of the snapshot that the sampler made after the step


@dataclass(frozen=True)
class LogPart:
    """Position of a batch of samples in the log to which they belong."""

    after: str | None = None  # ``AddedSamples.digest`` of the previous batch; None for the first batch of a log
    complete: bool = True  # whether this is the last batch of the log


@dataclass(frozen=True)
class AddedSamples:
    """Result of adding a batch of samples.

    A log comes in batches. A log that begins like a stored log shares the stored samples. If a later batch continues
    differently, nothing is stored, ``restart`` is set, and the log has to be sent again.

    Attributes:
        ids: ids of the samples, in order.
        duplicates: number of samples that had been stored before.
        digest: hash of the log up to the end of the batch; None if the samples belong to no log.
        restart: value of ``LogPart.after`` with which the log has to be sent again from its start; None if the batch
            was stored.
    """

    ids: tuple[int, ...]
    duplicates: int
    digest: str | None = None
    restart: str | None = None


@dataclass(frozen=True, kw_only=True)
class SampleRecord(Sample):
    """A stored sample, with its purpose, its sampler and its lease."""

    id: int
    purpose: SamplePurpose
    sampler: str
    attempt: int  # number of the query's lease under which the sample came, from 1; 0 without a query
    late: bool  # whether the lease had ended when the sample came
    trajectory: int | None  # a number that all samples of one rollout share; None if the sample belongs to no rollout
    requested_coordinates: Vector | None  # (C,) the C coordinates in the query; None without one, or in a rollout
    created_at: float


# Counts of real steps, entries of the list of surrogates, and other stored records


@dataclass(frozen=True)
class LedgerRecord:
    """Counts of real steps by purpose.

    ``unresolved`` counts the steps that may have been taken under leases that ended without an answer: ``failed`` of
    them under leases that a sampler ended with an error, the others under leases that expired. ``resets`` counts the
    rollouts that began at a reset, and ``wear`` the steps in which an entry of a continuous action was at a bound; both
    without logs and evaluations.
    """

    initial: int = 0
    adaptive: int = 0
    manual: int = 0
    audit: int = 0
    logged: int = 0
    evaluation: int = 0
    unresolved: int = 0
    failed: int = 0
    resets: int = 0
    wear: int = 0

    @property
    def total(self) -> int:
        """Number of real steps that count towards the budget."""
        return self.initial + self.adaptive + self.manual

    @property
    def samples(self) -> int:
        """Number of samples from which the model learns."""
        return self.total + self.audit + self.logged


@dataclass(frozen=True)
class SurrogateSummary:
    """Entry in the list of surrogates, without specification and model."""

    id: int
    name: str
    budget: int
    target: float
    phase: Phase
    paused: bool
    round: int
    error: str | None  # why the design failed or can't continue; None if it has no error
    created_at: float
    environment: str
    ledger: LedgerRecord
    queries: QueryCounts
    model_version: int | None  # version of the newest undamaged model; None without a model
    confidence_index: float | None  # confidence index of the newest undamaged model; None without a model


@dataclass(frozen=True)
class PriorRecord:
    """Description of a prior. If ``awaited`` is True, the design still waits for its model."""

    created_at: float
    about: JSON
    awaited: bool


@dataclass(frozen=True)
class OccupancyRecord:
    checkpoint: str
    round: int  # number of rounds of the design when these visited states were submitted
    created_at: float
    states: Array  # (m, C) coordinates of the m states that policies visited


@dataclass(frozen=True)
class SavedSession:
    id: str
    surrogate: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class EventRecord:
    id: int
    kind: EventKind
    created_at: float
    body: JSON


def fingerprint(*parts: object) -> str:
    """Return a hash of JSON values and bytes, to compare the contents of requests with the same idempotency key."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=bytes.hex).encode()).hexdigest()
