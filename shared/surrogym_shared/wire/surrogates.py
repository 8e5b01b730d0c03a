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

    model_config = ConfigDict(extra="forbid", strict=False)  # the specification checks its own types strictly

    name: SurrogateName = Field(description="name of the surrogate")
    spec: EnvironmentSpec = Field(
        description="what is known of the original environment beforehand, and settings of the design"
    )


class PatchSurrogate(Request):
    """Changes of a surrogate's design. A field that is null stays as it is."""

    paused: bool | None = Field(
        default=None,
        description="true pauses the design, false continues it and puts queries that were set aside back into the "
        "queue",
    )
    budget: Annotated[int, Field(ge=0, le=100_000)] | None = Field(
        default=None, description="real steps that the design may take; 0: none, so all samples come from a log"
    )
    target: Annotated[float, Field(gt=0.5, lt=1)] | None = Field(default=None, description="confidence index to reach")
    tolerances: dict[str, Positive | None] | None = Field(
        default=None,
        description="tolerance of each named output, in its own unit; null removes a tolerance that was set "
        "before; outputs without an entry stay as they are",
    )


class DoubtfulRegion(Reply):
    """A range of one coordinate or action entry in which the model is uncertain about an output."""

    input: str = Field(description="name of the coordinate; ``action``, or ``action 1``, ``action 2``...")
    low: float | None = Field(description="lower end of the range; null: none")
    high: float | None = Field(description="upper end of the range; null: none")
    outside: bool = Field(description="whether the doubt is outside of the range")
    share: float = Field(description="share of the output's doubt over the Monte Carlo set that lies there")


class PrequentialScores(Reply):
    """Scores of how well the last samples of an output, 20 at most, were predicted before the model learned from them.

    Each sample that the design, an audit or a person chose after the first fit is predicted by the latest model that
    has not learned from it. The standard deviation is that for the optimum of the hyperparameters, and includes the
    learned noise. An error within the tolerance counts as inside every interval. The design chooses samples where the
    model is uncertain, so their errors are not representative. These scores are reported, and no verdict depends on
    them.
    """

    predictions: int = Field(description="number of samples that were predicted")
    within_50: float = Field(description="share of them in the central 50 % interval, or within the tolerance")
    within_80: float = Field(description="the same for the 80 % interval")
    within_90: float = Field(description="the same for the 90 % interval")
    interval_score: float = Field(
        description="mean interval score (Gneiting and Raftery 2007, eq. 43) of the 90 % intervals, which are at least "
        "as wide as the tolerance, divided by the tolerance; lower is better, and 2 is the least"
    )


class OutputFidelity(Reply):
    """How well the model predicts one output."""

    name: str = Field(description="name of the output")
    structure: str = Field(description="inputs and kernel that were chosen, in words")
    confidence_index: float = Field(
        description="mean Phi(tolerance / standard deviation) over the Monte Carlo set (eq. 8, 9); a noisy output "
        "has a wider tolerance there: 1.5 standard deviations of its noise"
    )
    confidence_index_paper: float = Field(description="mean Phi(1 / standard deviation): the paper's, in raw units")
    tolerance: float = Field(description="error that is too small to matter, in the output's unit")
    coverage: float = Field(description="share of the Monte Carlo set whose standard deviation is below the tolerance")
    leave_one_out_error: float | None = Field(
        description="root mean square error of each sample's prediction from all others, in the output's unit; "
        "null if the family of models can't compute it"
    )
    leave_one_out_within_one: float | None = Field(
        default=None,
        description="share of the samples that are predicted from all others with an error below one predicted "
        "standard deviation: near 0.68 if these are right; null if the family can't compute it, or if "
        "the model is older than this field",
    )
    leave_one_out_within_two: float | None = Field(
        default=None, description="the same below two predicted standard deviations: near 0.95"
    )
    noise: float = Field(
        default=0.0,
        description="standard deviation of a single step's noise, if repeated or consecutive steps confirm it, in the "
        "output's unit; it is part of ``tolerance``; 0 without confirmed noise",
    )
    sensor_noise: float = Field(
        default=0.0,
        description="standard deviation of one measurement's error, in the output's unit, if consecutive steps of an "
        "episode show that most of ``noise`` is the sensor's; 0: it is the process's, or can't be told",
    )
    past: float = Field(
        default=0.0,
        description="share of the squared errors that the action and the change of the step before explain, if it is "
        "most of them: the sign of a dead time or of a state that is not measured; no noise is confirmed then",
    )
    region: DoubtfulRegion | None = Field(
        default=None, description="where most of the doubt is; null if no range of a single input has most of it"
    )
    prequential: PrequentialScores | None = Field(
        default=None,
        description="scores of samples that were predicted before they were learned from; null if there are none",
    )


class ReachedLimit(Reply):
    """A declared limit of a coordinate at which many samples end."""

    coordinate: str = Field(description="name of the coordinate")
    side: Side
    value: float = Field(description="the limit, in the coordinate's unit")
    share: float = Field(description="share of the samples that end there")


class Fidelity(Reply):
    """How well a model predicts: the smallest confidence index of its outputs, and the values of each output."""

    confidence_index: float = Field(description="smallest confidence index of the outputs, with their tolerances")
    confidence_index_paper: float = Field(
        description="smallest confidence index as the paper defines it, with a tolerance of 1 in raw units"
    )
    target: float = Field(description="confidence index to reach")
    samples: int = Field(description="number of samples that the model was fitted to")
    outputs: list[OutputFidelity] = Field(description="values of each output")
    limits: list[ReachedLimit] = Field(
        default=[], description="declared limits at which many samples end, which says little about the dynamics"
    )


class Ledger(Reply):
    """Counts of real steps by purpose.

    ``total`` is the cost of the design: initial + adaptive + manual. It excludes audits, evaluations, and ``logged``
    steps, which were recorded before and don't count towards the budget. ``unresolved`` counts steps that may have been
    taken under leases that ended without an answer, so the design took between total and total + unresolved steps. Of
    these, ``failed`` steps were returned by a sampler with an error; the leases of the others expired.
    """

    initial: int = Field(default=0, description="steps of the first queries, before any model")
    adaptive: int = Field(default=0, description="steps of queries that the acquisition chose")
    manual: int = Field(default=0, description="steps of queries by hand, and steps without a query")
    audit: int = Field(default=0, description="steps of audits")
    logged: int = Field(default=0, description="steps that were recorded before")
    total: int = Field(default=0, description="initial + adaptive + manual, which the budget limits")
    evaluation: int = Field(default=0, description="steps of evaluations, as reported")
    unresolved: int = Field(default=0, description="steps that may have been taken, but were not reported")
    failed: int = Field(default=0, description="those of the unresolved steps that a sampler returned with an error")


class QueryCounts(Reply):
    """Numbers of a surrogate's queries, by status."""

    pending: int = Field(default=0, description="no sampler has them")
    leased: int = Field(default=0, description="a sampler has them")
    answered: int = Field(default=0, description="with samples")
    set_aside: int = Field(default=0, description="failed in all their attempts")
    refused: int = Field(default=0, description="refused by the original environment before a real step")


class SurrogateSummary(Reply):
    """Summary of a surrogate, as in a list of surrogates."""

    name: str = Field(description="name of the surrogate")
    environment: str = Field(description="name of the original environment")
    phase: Phase = Field(description="present phase of the design")
    paused: bool = Field(description="whether the design is paused; then no sampler gets queries")
    round: int = Field(description="number of fits so far")
    samples: int = Field(description="number of samples")
    model_version: int | None = Field(description="version of the newest model; null without a model")
    confidence_index: float | None = Field(
        description="smallest confidence index of the newest model's outputs; null without a model"
    )
    target: float = Field(description="confidence index to reach")
    budget: int = Field(description="real steps that the design may take")
    ledger: Ledger = Field(description="real steps so far, by purpose")
    queries: QueryCounts = Field(description="numbers of queries, by status")
    samplers: list[str] = Field(
        default=[], description="names of the samplers that sent a request within the last minute"
    )
    sessions: int = Field(default=0, description="number of open sessions")
    created_at: float = Field(description="when it was registered, in seconds since 1970, by the server's clock")


class SurrogateView(SurrogateSummary):
    """A surrogate with its specification and the fidelity of its newest model."""

    spec: EnvironmentSpec = Field(description="what was declared of the original environment")
    budget_left: int = Field(
        description="real steps of the budget that are neither taken, nor requested by a query, nor reserved for a "
        "request of more queries"
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

    created: bool = Field(description="whether this request created it; false: it existed, with the same specification")


class CheckedSurrogate(Reply):
    """Reply to the check of a registration: what it would store. Nothing was stored."""

    name: str = Field(description="name of the surrogate")
    spec: EnvironmentSpec = Field(description="with the default of every field that the request left out")
    budget: int = Field(description="real steps that the design would be allowed to take")
    target: float = Field(description="confidence index to reach")
    initial: int = Field(description="real steps of the initial queries")
    outputs: list[str] = Field(description="quantities that the model would predict")
    exists: bool = Field(description="whether there is a surrogate of this name and specification")


class ImprovedSurrogate(SurrogateView):
    """Reply to a request for more queries: the surrogate, and by how much its budget was raised."""

    budget_raised_by: int = Field(description="real steps that the request added to the budget; 0: it had enough left")


class SurrogateList(Reply):
    """One page of surrogates, oldest first."""

    surrogates: list[SurrogateSummary] = Field(description="surrogates of this page")
    next_after: int | None = Field(
        default=None,
        exclude_if=lambda after: after is None,  # omitted on the last page, because older clients refuse the field
        description="value of ``after`` for the next page; omitted on the last page",
    )
