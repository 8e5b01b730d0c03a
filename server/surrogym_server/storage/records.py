"""Records of storage: frozen, and independent of any database and of the wire.

Shapes: C coordinates, F action entries, D observation entries. Times are seconds since 1970, on the database's clock.
``JSON`` is a value that ``json.dumps`` and ``json.loads`` return unchanged.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.nouns import Query, RealStep, Vector
from surrogym_shared.states import EventKind, Phase, Purpose, QueryStatus, SamplePurpose

Array = NDArray[np.float64]
JSON = dict[str, Any]
FREE = ("audit", "logged")  # purposes of samples that don't count towards the budget
Synchronous = Literal["full", "normal"]  # full: every commit of a SQLite file waits for the disk

OPEN_STATUSES: tuple[QueryStatus, ...] = ("pending", "leased")


# Surrogates and their design


@dataclass(frozen=True)
class NewSurrogate:
    """A surrogate to create, with the queries of its first round."""

    name: str
    spec: JSON
    budget: int
    target: float
    queries: tuple[Query, ...] = ()


@dataclass(frozen=True)
class Standing:
    """Id of a surrogate, and its fields that change often."""

    id: int
    phase: Phase
    paused: bool


@dataclass(frozen=True)
class SurrogateRecord:
    id: int  # unlike a name, never used again after a deletion
    name: str
    spec: JSON
    budget: int
    target: float
    tolerances: dict[str, float]  # tolerances that people set after its creation, by output
    phase: Phase
    paused: bool
    round: int  # rounds of the design so far
    state: JSON  # state of the design
    error: str | None
    extra_queries: int  # real steps that ``Designs.improve`` requested and no fit has chosen yet
    checkpoint: str | None  # occupancy that the last request to improve named
    created_at: float


@dataclass(frozen=True)
class Granted:
    """Result of ``Designs.improve``: the surrogate, and by how much its budget was raised."""

    record: SurrogateRecord  # the surrogate after the change
    raised: int  # real steps by which the budget was raised


@dataclass(frozen=True)
class FitLease:
    """The right to fit one surrogate, until it expires. It is passed to renew, commit or abort."""

    surrogate: str
    token: str
    revision: int  # revision of the surrogate when the fit began
    extra_queries: int  # real steps that this fit has to choose even if the design has ended
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
    """A model without its bytes."""

    version: int  # 1, 2, ... per surrogate
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
    extra: bool = False  # the queries come from ``Designs.improve``, and the design itself would not have chosen them


# Queries and samples


@dataclass(frozen=True, kw_only=True)
class QueryRecord(Query):
    """A stored query and its state."""

    id: int
    purpose: Purpose
    status: QueryStatus
    round: int
    attempts: int  # number of leases so far
    sampler: str | None  # name of the sampler that claimed the query last
    error: str | None  # error of the last failed attempt
    lease_seconds_left: float | None = (
        None  # of the open lease, by the database's clock; negative once it has expired, None without a lease
    )


@dataclass(frozen=True, kw_only=True)
class LeasedQuery(Query):
    """A stored query and the lease under which a sampler answers it."""

    id: int
    number: int  # number of earlier queries of the same surrogate
    purpose: Purpose
    attempt: int  # 1 for the first lease of this query
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
    """A real step as a sampler took it; its entries are floats, and it may answer a query."""

    coordinates: Vector
    action: Vector
    next_coordinates: Vector
    observation: Vector | None = None
    next_observation: Vector | None = None
    query_id: int | None = None
    step: int = 0  # position of this step in its rollout, from 0


@dataclass(frozen=True)
class NewSample(Sample):
    """A sample that a sampler reports. ``query_id`` and ``lease_token`` are both present or both absent."""

    lease_token: str | None = None
    snapshot: str | None = None  # name of the snapshot that the sampler made after the step


@dataclass(frozen=True)
class LogPart:
    """Where in a log the samples of a report belong."""

    after: str | None = None  # ``AddedSamples.digest`` of the part before; None for the first part of a log
    complete: bool = True  # this is the last part of the log


@dataclass(frozen=True)
class AddedSamples:
    """Result of adding a batch of samples.

    A log comes in several batches, and a log that begins like a stored one shares its samples with it. If the two
    differ within a batch, the batch has to be sent again from the sample at which they differ. Then nothing was stored,
    and ``restart`` is set.

    Attributes:
        ids: ids of the samples, in order.
        duplicates: number of samples that had been stored before.
        digest: hash of the log up to the end of the batch; None if the samples are not logged.
        restart: hash of the log up to the sample from which it has to be sent again; None if the batch was stored.
    """

    ids: tuple[int, ...]
    duplicates: int
    digest: str | None = None
    restart: str | None = None


@dataclass(frozen=True, kw_only=True)
class SampleRecord(Sample):
    """A stored sample."""

    id: int
    purpose: SamplePurpose
    sampler: str
    attempt: int  # number of the lease of its query; 0 without a query
    late: bool  # the sample came under a lease that had ended
    trajectory: int | None  # the same number for all samples of one rollout, which follow each other
    requested_coordinates: Vector | None  # (C,) of the query; None without a query, and for a rollout
    created_at: float


# Ledger, lists and memory


@dataclass(frozen=True)
class LedgerRecord:
    """Acknowledged real steps by purpose.

    ``unresolved`` counts the steps that may have been taken under leases that ended without an answer. Of these,
    ``failed`` were under leases that a sampler returned with an error; the others expired.
    """

    initial: int = 0
    adaptive: int = 0
    manual: int = 0
    audit: int = 0
    logged: int = 0
    evaluation: int = 0
    unresolved: int = 0
    failed: int = 0

    @property
    def total(self) -> int:
        """Real steps that count towards the budget."""
        return self.initial + self.adaptive + self.manual

    @property
    def samples(self) -> int:
        """Number of samples that the model learns from."""
        return self.total + self.audit + self.logged


@dataclass(frozen=True)
class SurrogateSummary:
    """Entry of a list of surrogates."""

    id: int
    name: str
    budget: int
    target: float
    phase: Phase
    paused: bool
    round: int
    error: str | None  # error of the design, which may explain the phase
    created_at: float
    environment: str
    ledger: LedgerRecord
    queries: QueryCounts
    model_version: int | None  # version of the latest model
    confidence_index: float | None  # confidence index of the latest model


@dataclass(frozen=True)
class PriorRecord:
    """Description of a prior. ``awaited``: the design waits for it."""

    created_at: float
    about: JSON
    awaited: bool


@dataclass(frozen=True)
class OccupancyRecord:
    checkpoint: str
    round: int  # round of the design in which the occupancy was submitted
    created_at: float
    states: Array  # (m, C) visited states


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
    """A hash that is equal for equal bodies, to compare requests with the same idempotency key."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
