"""One round of the design as a picklable job on arrays: fit a model, compute its confidence, choose the next queries.

The result is a pure function of the job, so it can run in another process, and the same job gives the same result. The
fidelity of a model (confidence index, tolerances, errors) becomes JSON here, for fitted and for imported models.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.guard import plugin_calls
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.confidence import OutputConfidence, confidences_of, stds
from surrogym_server.sampling.design import Decision, advance
from surrogym_server.sampling.judging import judge_model, monte_carlo
from surrogym_server.sampling.limits import Limit, reached_limits
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.surprises import Surprises, surprises_of
from surrogym_server.sampling.tolerances import default_tolerances
from surrogym_shared.nouns import Query, RealSteps
from surrogym_shared.states import Phase, SamplePurpose, Verdict

Array = NDArray[np.float64]

# Purposes of samples whose states and actions were not chosen by means of a model.
UNCHOSEN: tuple[SamplePurpose, ...] = ("initial", "logged")
LATEST = 20  # greatest number of new samples whose errors by the previous model are computed


@dataclass(frozen=True)
class DesignJob:
    """Input of one round of a design, as plain arrays and values that pickle."""

    definition: EnvironmentDefinition
    samples: RealSteps  # all real steps of the surrogate so far, from which the model learns
    state: dict[str, Any]  # state of the design after the previous round (DesignState as JSON); {} before the first
    budget: int  # largest number of real steps that the design may take
    target: float  # the design ends when the model's confidence index reaches this number
    pending: tuple[Query, ...] = ()  # queries without an answer, which a sampler may still take or which were set aside
    # Number of real steps of the queries that are still to be taken, without queries that were set aside.
    open_steps: int = 0
    refused: tuple[Query, ...] = ()  # queries that the original environment refused, such as an unreachable state
    snapshots: dict[str, tuple[float, ...]] = field(default_factory=dict)  # coordinates (C,) of each snapshot, by name
    extra_queries: int = 0  # number of queries requested beyond those of the design, also after the design has ended
    occupancy: Array | None = None  # (m, C) coordinates of m states that policies visited in virtual episodes
    threads: int = 1
    previous: bytes | None = None  # file of the previous round's model, which predicts the samples that came since
    prior: bytes | None = None  # file of a prior model, such as one learned from a simulator; None without a prior


@dataclass(frozen=True)
class DesignResult:
    """Result of one round of a design. ``model`` is a complete safetensors file: loading it recomputes nothing."""

    model: bytes
    description: dict[str, Any]
    fidelity: dict[str, Any]  # confidence and errors of the model, as the fields of ``wire.Fidelity``
    data_hash: str
    state: dict[str, Any]
    verdict: Verdict
    seconds: float
    queries: tuple[Query, ...] = ()  # requested real steps; the next round begins when samplers have taken them

    @property
    def phase(self) -> Phase:
        """Phase of the design after this round: ``sampling`` if the verdict is ``continue`` or the round chose
        queries, else the verdict, such as ``ready``."""
        return "sampling" if self.verdict == "continue" or self.queries else self.verdict


def run_design_job(job: DesignJob) -> DesignResult:
    """Do one round of a design: fit a model, compute its confidence, choose queries.

    Raises the errors of ``sampling.design.advance``.
    """
    begin = time.perf_counter()
    torch.set_num_threads(job.threads)
    with threadpool_limits(job.threads):  # limits NumPy's threads, too many of which slow small matrix products
        decision, samples = _decide(job)
    with plugin_calls(job.definition):
        model = to_bytes(decision.model)
    return DesignResult(
        model=model,
        description=json.loads(json.dumps(decision.model.description)),  # converts a plug-in's types to JSON types
        fidelity=fidelity_fields(
            decision.model,
            decision.confidences,
            decision.tolerances,
            job.target,
            reached_limits(job.definition, samples),
        ),
        data_hash=samples.digest,
        state=decision.state.to_json(),
        verdict=decision.verdict,
        seconds=time.perf_counter() - begin,
        queries=decision.queries,
    )


def judge_stored(job: DesignJob, data: bytes) -> DesignResult:
    """Compute the confidence of a stored model (``data``, a safetensors file) and the verdict on the design, without a
    fit.

    No queries are chosen. The verdict is ``continue`` if the model was fitted to other samples than those of the job.

    Raises:
        InvalidInput: the model does not fit the job's environment definition.
    """
    begin = time.perf_counter()
    model, samples = from_bytes(job.definition, data), _samples(job)
    state = DesignState.from_json(job.state)
    defaults = state.defaults.values or default_tolerances(job.definition, model.scales.tolist())
    judgement = judge_model(model, samples, job.definition.tolerances_or(defaults), _request(job), state)
    return DesignResult(
        model=data,
        description=model.description,
        fidelity=fidelity_fields(
            model,
            judgement.confidences,
            judgement.widened_tolerances,
            job.target,
            reached_limits(job.definition, samples),
        ),
        data_hash=model.digest,
        state=job.state,
        verdict=judgement.verdict if model.digest == samples.digest else "continue",
        seconds=time.perf_counter() - begin,
    )


def _decide(job: DesignJob) -> tuple[Decision, Samples]:
    samples, state = _samples(job), DesignState.from_json(job.state)
    request = replace(_request(job), surprises=errors_of_new(job, samples))
    return advance(job.definition, samples, state, request), samples


def errors_of_new(job: DesignJob, samples: Samples) -> Surprises:
    """Return the errors of the latest samples that came after the previous round, by that round's model, which has not
    learned from them. Samples that no model chose, those of the initial design and of logs, are left out.

    The result is empty without a previous model, or if it learned from other samples, as an imported model did.
    """
    if job.previous is None:
        return ()
    with suppress(InvalidInput), plugin_calls(job.definition):
        model = from_bytes(job.definition, job.previous)
        if model.digest == samples.at(torch.arange(min(model.samples, len(samples)))).digest:
            is_chosen = torch.tensor([purpose not in UNCHOSEN for purpose in job.samples.purpose])
            new = (
                is_chosen[_is_known(job)].index_fill(0, torch.arange(model.samples), value=False).nonzero()[-LATEST:, 0]
            )
            return surprises_of(model, samples.at(new))
    return ()


def _samples(job: DesignJob) -> Samples:
    """Return the samples from which a model can learn: those in which all coordinates that repeat a past value (lags)
    are known."""
    return Samples.of(job.samples).at(_is_known(job))


def _is_known(job: DesignJob) -> torch.Tensor:
    """Return for each of n samples whether all coordinates that repeat a past value (lags) are known before the step,
    (n,) bool."""
    return job.definition.known(torch.from_numpy(job.samples.coordinates))


def _request(job: DesignJob) -> Request:
    return Request(
        budget=job.budget,
        target=job.target,
        pending=job.pending,
        refused=job.refused,
        snapshots=job.snapshots,
        extra=job.extra_queries,
        states=None if job.occupancy is None else torch.from_numpy(job.occupancy),
        logged=job.samples.purpose.count("logged"),
        audited=job.samples.purpose.count("audit"),
        unlearned=int((~_is_known(job)).sum()),
        open=job.open_steps,
        prior=None if job.prior is None else from_bytes(job.definition, job.prior),
    )


def fidelity_fields(
    model: DynamicsModel,
    confidences: Sequence[OutputConfidence],
    tolerances: Sequence[float],
    target: float,
    limits: Sequence[Limit] = (),
) -> dict[str, Any]:
    """Return how well a model knows each output (confidence index, tolerance, errors), as the fields of
    ``wire.Fidelity``.

    Args:
        model: the model.
        confidences: (O,) confidence of each output.
        tolerances: (O,) tolerance of each output, in its unit.
        target: confidence index that the design aims at.
        limits: declared limits of coordinates at which many samples end.
    """
    rows = [
        {"name": name, "structure": structure, "tolerance": tolerance, **asdict(output)}
        for name, structure, output, tolerance in zip(
            model.definition.outputs, model.structures, confidences, tolerances, strict=True
        )
    ]
    return {
        "confidence_index": min(c.confidence_index for c in confidences),
        "confidence_index_paper": min(c.confidence_index_paper for c in confidences),
        "target": target,
        "samples": model.samples,
        "outputs": rows,
        "limits": [asdict(limit) for limit in limits],
    }


def fidelity_of(model: DynamicsModel, defaults: Sequence[float], target: float) -> dict[str, Any]:
    """Compute how well a model knows each output (confidence index, tolerance, errors), and return this as the fields
    of ``wire.Fidelity``.

    Args:
        model: the model.
        defaults: (O,) tolerances for outputs without a declared one. If empty, as before the first round of a design,
            they are computed from the scales of the model's outputs.
        target: confidence index that the design aims at.
    """
    defaults = defaults or default_tolerances(model.definition, model.scales.tolist())
    tolerances = model.definition.tolerances_or(defaults)
    points = Points(*monte_carlo(model.definition))
    confidences = confidences_of(model, points, stds(model, points.q, points.u), tolerances)
    return fidelity_fields(model, confidences, tolerances, target)
