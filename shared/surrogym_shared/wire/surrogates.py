"""Wire models of surrogates: create, list, change."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from surrogym_shared.checks import Positive
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import Phase, Reply, Request, SurrogateName


class CreateSurrogate(Request):
    model_config = ConfigDict(extra="forbid", strict=False)  # the specification validates its own types

    name: SurrogateName
    spec: EnvironmentSpec


class PatchSurrogate(Request):
    """Changes of a running design. None leaves a field as it is. With a budget of 0, the design takes no real step."""

    paused: bool | None = None
    budget: Annotated[int, Field(ge=0, le=100_000)] | None = None
    target: Annotated[float, Field(gt=0.5, lt=1)] | None = None
    tolerances: dict[str, Positive | None] | None = Field(
        default=None,
        description="by output, in its own unit; null takes back what was set, those of other outputs stay as they are",
    )


class OutputFidelity(Reply):
    """How well one output is predicted. ``unit`` is the output's own."""

    name: str
    structure: str = Field(description="Chosen inputs and kernel, in words.")
    confidence_index: float = Field(description="mean Phi(tolerance / deviation) over the Monte Carlo set (eq. 8, 9)")
    confidence_index_paper: float = Field(description="mean Phi(1 / deviation): the paper's, in raw units")
    tolerance: float
    coverage: float = Field(description="share of the Monte Carlo set whose deviation is below the tolerance")
    leave_one_out_error: float | None = Field(
        description="root mean square, in the output's unit; None where the family of models can't tell"
    )
    leave_one_out_within_one: float | None = Field(
        default=None,
        description="share of the samples that the model without them predicts within one of its deviations: near 0.68 "
        "where the deviations tell the truth; None where the error is, and for a model fitted before this was counted",
    )
    leave_one_out_within_two: float | None = Field(default=None, description="the same within two deviations: 0.95")
    noise: float = Field(
        default=0.0,
        description="deviation of the noise of a single step that repeated steps confirm; it widens the tolerance",
    )


class Fidelity(Reply):
    confidence_index: float = Field(description="smallest over outputs, with tolerances")
    confidence_index_paper: float = Field(description="smallest over outputs, as printed in the paper")
    target: float
    samples: int
    outputs: list[OutputFidelity]


class Ledger(Reply):
    """Acknowledged real steps by purpose.

    ``total`` is the cost of the design: initial + adaptive + manual. It excludes evaluation, and ``logged`` steps,
    which were recorded before and don't count towards the budget. ``unresolved`` counts steps that may have been taken
    under leases that ended without an answer, so the true number of real steps is between total and total + unresolved.
    ``failed`` of the unresolved ones were returned by a sampler with an error; the leases of the others expired.
    """

    initial: int = 0
    adaptive: int = 0
    manual: int = 0
    audit: int = 0
    logged: int = 0
    total: int = 0
    evaluation: int = 0
    unresolved: int = 0
    failed: int = 0


class QueryCounts(Reply):
    pending: int = 0
    leased: int = 0
    answered: int = 0
    set_aside: int = 0


class SurrogateSummary(Reply):
    name: str
    environment: str
    phase: Phase
    paused: bool
    round: int = Field(description="fits so far")
    samples: int
    model_version: int | None
    confidence_index: float | None
    target: float = Field(description="confidence index to reach")
    budget: int = Field(description="real steps the design may take")
    ledger: Ledger
    queries: QueryCounts
    samplers: list[str] = Field(
        default=[], description="names of the samplers that sent a request within the last minute"
    )
    sessions: int = Field(default=0, description="open ones")
    created_at: float = Field(description="seconds since 1970, the server's clock")


class SurrogateView(SurrogateSummary):
    spec: EnvironmentSpec
    budget_left: int = Field(
        description="real steps of the budget that are not taken, not queried, and not promised to a request for more"
    )
    tolerances: dict[str, float] = Field(description="set since the surrogate was created, by output, in its own unit")
    outputs: list[str]
    fidelity: Fidelity | None
    error: str | None = Field(default=None, description="why the phase is failed, or the last query was set aside")


class CreatedSurrogate(SurrogateView):
    """Reply to a registration: the surrogate, and whether it is new."""

    created: bool = Field(description="whether this request made it; false: it was there, with the same specification")


class CheckedSurrogate(Reply):
    """Reply to the check of a registration: what it would store. Nothing was stored."""

    name: str
    spec: EnvironmentSpec = Field(description="with the default of every field that the request left out")
    budget: int = Field(description="real steps that the design would be allowed to take")
    target: float = Field(description="confidence index to reach")
    initial: int = Field(description="real steps of the initial queries")
    outputs: list[str] = Field(description="quantities that the model would predict")
    exists: bool = Field(description="whether there is a surrogate of this name and specification")


class ImprovedSurrogate(SurrogateView):
    """Reply to a request for more queries: the surrogate, and by how much its budget was raised."""

    budget_raised_by: int = Field(description="real steps that the request added to the budget; 0: it held them")


class SurrogateList(Reply):
    surrogates: list[SurrogateSummary]
    next_after: int | None = Field(
        default=None,
        exclude_if=lambda after: after is None,  # left out of a complete list, because older clients don't know pages
        description="give it as ``after`` for the next page; left out where this is the last",
    )
