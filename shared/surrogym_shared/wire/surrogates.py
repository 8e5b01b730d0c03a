"""Wire models of surrogates: create, list, change."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from surrogym_shared.checks import Positive
from surrogym_shared.kinds import Side
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import Phase, Reply, Request, SurrogateName


class CreateSurrogate(Request):
    """Request to register a surrogate."""

    # Not strict here, because ``EnvironmentSpec`` checks the types of its fields.
    model_config = ConfigDict(extra="forbid", strict=False)

    name: SurrogateName = Field(description="name of the surrogate")
    spec: EnvironmentSpec = Field(
        description="what is known of the original environment beforehand, and settings of the design"
    )


class PatchSurrogate(Request):
    """Changes of a surrogate's design. A field that is null stays as it is."""

    paused: bool | None = Field(
        default=None,
        description="true: pause the design; false: continue it, and queue the queries again that were set aside or "
        "refused",
    )
    budget: Annotated[int, Field(ge=0, le=100_000)] | None = Field(
        default=None, description="real steps that the design may take; 0: none, so all samples come from a log"
    )
    target: Annotated[float, Field(gt=0.5, lt=1)] | None = Field(default=None, description="confidence index to reach")
    tolerances: dict[str, Positive | None] | None = Field(
        default=None,
        description="tolerance of each named output, in the output's unit; null restores its default. Outputs without "
        "an entry stay as they are",
    )


class DoubtfulRegion(Reply):
    """A range of one coordinate or action entry in which the model is uncertain about an output."""

    input: str = Field(
        description="name of the coordinate, or of the action entry: ``action``, or ``action 1``, ``action 2``..."
    )
    low: float | None = Field(description="lower end of the range; null: no lower end")
    high: float | None = Field(description="upper end of the range; null: no upper end")
    outside: bool = Field(description="whether the model is uncertain outside of the range instead of inside")
    share: float = Field(
        description="share of the output's total uncertainty, summed over random points of the sampling ranges, that "
        "lies there"
    )


class OutputFidelity(Reply):
    """How well the model predicts one output."""

    model_config = ConfigDict(extra="ignore")  # databases of earlier versions have scores that were removed

    name: str = Field(description="name of the output")
    structure: str = Field(description="inputs and kernel that the fit has chosen, in words")
    confidence_index: float = Field(
        description="mean of Phi(``tolerance`` / standard deviation) over random points of the sampling ranges (eq. 8, "
        "9)"
    )
    confidence_index_paper: float = Field(
        description="mean of Phi(1 / standard deviation), the paper's definition in raw units"
    )
    tolerance: float = Field(
        description="error that is too small to matter, in the output's unit; with confirmed noise, the square root of "
        "the sum of the squares of the output's tolerance and of ``noise``"
    )
    coverage: float = Field(
        description="share of random points of the sampling ranges at which the standard deviation is below the "
        "tolerance"
    )
    leave_one_out_error: float | None = Field(
        description="root mean square error of each sample's prediction from all others, in the output's unit; "
        "null if the family of models can't compute it"
    )
    leave_one_out_within_one: float | None = Field(
        default=None,
        description="share of the samples that are predicted from all others with an error below one predicted "
        "standard deviation: near 0.68 if the deviations are right; null if the family of models can't "
        "compute it, or if the model is older than this field",
    )
    leave_one_out_within_two: float | None = Field(
        default=None,
        description="share of the samples that are predicted from all others with an error below two predicted "
        "standard deviations: near 0.95 if the deviations are right; null as ``leave_one_out_within_one``",
    )
    noise: float = Field(
        default=0.0,
        description="standard deviation of a single step's noise, if repeated or consecutive steps confirm it, in the "
        "output's unit; ``tolerance`` includes it; 0 without confirmed noise",
    )
    sensor_noise: float = Field(
        default=0.0,
        description="standard deviation of one measurement's error, in the output's unit, if consecutive steps of an "
        "episode show that most of ``noise`` is measurement error; 0: it is process noise, or this is unknown",
    )
    past: float = Field(
        default=0.0,
        description="share of the squared errors that the action and the change of the previous step explain; 0 unless "
        "it is most of them. It indicates a dead time or an unmeasured state, and no noise is confirmed then",
    )
    region: DoubtfulRegion | None = Field(
        default=None,
        description="where the model is most uncertain about the output; null if no range of a single input stands out",
    )


class ReachedLimit(Reply):
    """A declared limit of a coordinate at which many samples end."""

    coordinate: str = Field(description="name of the coordinate")
    side: Side
    value: float = Field(description="the limit, in the coordinate's unit")
    share: float = Field(description="share of the samples whose next state is at the limit")


class Fidelity(Reply):
    """How well a model predicts: the smallest confidence index of its outputs, and the values of each output."""

    confidence_index: float = Field(
        description="smallest confidence index of the outputs, computed with their tolerances"
    )
    confidence_index_paper: float = Field(
        description="smallest confidence index as the paper defines it, with a tolerance of 1 in raw units"
    )
    target: float = Field(description="confidence index that the design should reach")
    samples: int = Field(description="number of samples that the model was fitted to")
    outputs: list[OutputFidelity] = Field(description="how well the model predicts each output")
    limits: list[ReachedLimit] = Field(
        default=[], description="declared limits at which many samples end; such samples say little about the dynamics"
    )


class Ledger(Reply):
    """Counts of a surrogate's real steps by purpose.

    ``total`` is the cost of the design: initial + adaptive + manual. It excludes audits, evaluations, and ``logged``
    steps, which were recorded before and don't count towards the budget. ``unresolved`` counts steps that may have been
    taken under leases that ended without an answer, so the design took between total and total + unresolved steps. Of
    these, ``failed`` steps were returned by a sampler with an error; the leases of the others expired.

    ``resets`` and ``wear`` count what ``total`` + ``audit`` steps took from the machine.
    """

    initial: int = Field(default=0, description="steps of the initial queries, before the first model")
    adaptive: int = Field(default=0, description="steps of queries that the acquisition chose")
    manual: int = Field(default=0, description="steps of queries that a person added, and steps without a query")
    audit: int = Field(default=0, description="steps of audits")
    logged: int = Field(default=0, description="steps from logs, which were recorded before")
    total: int = Field(default=0, description="initial + adaptive + manual, which the budget limits")
    evaluation: int = Field(default=0, description="steps of evaluations, as clients reported them")
    unresolved: int = Field(default=0, description="steps that may have been taken, but whose samples did not come")
    failed: int = Field(
        default=0, description="part of ``unresolved``: steps of queries for which a sampler reported an error"
    )
    resets: int = Field(
        default=0, description="rollouts that began at a reset, without evaluations, and without rollouts of no sample"
    )
    wear: int = Field(
        default=0,
        description="steps in which an entry of a continuous action was at a bound of the specification, without logs "
        "and evaluations, and without steps stored before version 0.2.0",
    )


class QueryCounts(Reply):
    """Numbers of a surrogate's queries, by status."""

    pending: int = Field(default=0, description="number of queries that wait for a sampler")
    leased: int = Field(default=0, description="number of queries that a sampler has claimed")
    answered: int = Field(default=0, description="number of queries that samples have answered")
    set_aside: int = Field(default=0, description="number of queries that failed in all attempts")
    refused: int = Field(
        default=0, description="number of queries that the original environment refused before a real step"
    )


class SurrogateSummary(Reply):
    """Summary of a surrogate, as in a list of surrogates."""

    name: str = Field(description="name of the surrogate")
    environment: str = Field(description="name of the original environment")
    phase: Phase = Field(description="present phase of the design")
    paused: bool = Field(description="whether the design is paused; no sampler gets queries then")
    round: int = Field(description="number of rounds (fits) of the design so far")
    samples: int = Field(description="number of samples")
    model_version: int | None = Field(description="version of the newest model; null without a model")
    confidence_index: float | None = Field(
        description="smallest confidence index of the newest model's outputs; null without a model"
    )
    target: float = Field(description="confidence index that the design should reach")
    budget: int = Field(description="number of real steps that the design may take")
    ledger: Ledger = Field(description="counts of real steps so far, by purpose")
    queries: QueryCounts = Field(description="numbers of queries, by status")
    samplers: list[str] = Field(
        default=[], description="names of the samplers that sent a request within the last minute"
    )
    sessions: int = Field(default=0, description="number of open sessions")
    created_at: float = Field(
        description="when the surrogate was registered, in seconds since 1970, by the server's clock"
    )


class SurrogateView(SurrogateSummary):
    """A surrogate with its specification and the fidelity of its newest model."""

    spec: EnvironmentSpec = Field(
        description="what was declared about the original environment, with the settings of the design"
    )
    budget_left: int = Field(
        description="real steps of the budget that are neither taken, nor requested by a query, nor reserved for a "
        "request of more queries"
    )
    machine_seconds: float | None = Field(
        default=None,
        exclude_if=lambda seconds: seconds is None,
        description="seconds that the real steps of the design and of audits took: ``total`` + ``audit`` of the "
        "ledger, times the declared sampling period; left out if none is declared. The time of resets is not known, "
        "and not included",
    )
    tolerances: dict[str, float] = Field(
        description="tolerances that were set after the registration, by output, in the output's unit"
    )
    outputs: list[str] = Field(description="names of the quantities that the model predicts")
    fidelity: Fidelity | None = Field(description="how well the newest model predicts; null without a model")
    error: str | None = Field(
        default=None, description="why the design failed, or why the last query was set aside; null if neither happened"
    )


class CreatedSurrogate(SurrogateView):
    """Reply to a registration: the surrogate, and whether it is new."""

    created: bool = Field(
        description="whether this request created the surrogate; false: it existed with the same specification"
    )


class CheckedSurrogate(Reply):
    """Reply to the check of a registration: what it would store. Nothing was stored."""

    name: str = Field(description="name of the surrogate")
    spec: EnvironmentSpec = Field(
        description="complete specification, with the default of each field that the request left out"
    )
    budget: int = Field(description="real steps that the design would be allowed to take")
    target: float = Field(description="confidence index that the design should reach")
    initial: int = Field(description="number of real steps of the initial queries")
    outputs: list[str] = Field(description="names of the quantities that the model would predict")
    exists: bool = Field(description="whether there is a surrogate of this name and specification")


class ImprovedSurrogate(SurrogateView):
    """Reply to a request for more queries: the surrogate, and by how much its budget was raised."""

    budget_raised_by: int = Field(
        description="number of real steps that the request added to the budget; 0: the budget had enough left"
    )


class SurrogateList(Reply):
    """One page of surrogates, oldest first."""

    surrogates: list[SurrogateSummary] = Field(description="surrogates of this page")
    next_after: int | None = Field(
        default=None,
        exclude_if=lambda after: after is None,  # omitted on the last page, because older clients refuse the field
        description="value of ``after`` for the next page; omitted on the last page",
    )
