"""One round of the design as a picklable job on arrays: fit a model, compute its confidence, choose the next queries.

The result is a pure function of the job, so it can run in another process, and the same job gives the same result.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from surrogym_server.engine.fidelity import fidelity_fields
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.guard import plugin_calls
from surrogym_server.sampling.design import Decision, advance
from surrogym_server.sampling.judging import judge_model
from surrogym_server.sampling.limits import reached_limits
from surrogym_server.sampling.prequential import LATEST, Predictions, latest, predicted
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.tolerances import default_tolerances
from surrogym_shared.nouns import Query, RealSteps
from surrogym_shared.states import Phase, SamplePurpose, Verdict

Array = NDArray[np.float64]

UNCHOSEN: tuple[SamplePurpose, ...] = ("initial", "logged")  # purposes of samples that no model chose


@dataclass(frozen=True)
class DesignJob:
    """Input of one round of a design, as plain arrays and values that pickle."""

    definition: EnvironmentDefinition
    samples: RealSteps  # all real steps so far
    state: dict[str, Any]  # DesignState as JSON; {} before the first round
    budget: int  # largest number of real steps of the design
    target: float  # confidence index at which the design ends
    pending: tuple[Query, ...] = ()  # queries without an answer: open, or set aside
    open_steps: int = 0  # number of real steps of the open queries
    refused: tuple[Query, ...] = ()  # queries that the original environment refused
    snapshots: dict[str, tuple[float, ...]] = field(default_factory=dict)  # coordinates (C,) of each snapshot, by name
    extra_queries: int = 0  # number of further queries that a person requested, also after the end of the design
    occupancy: Array | None = None  # (m, C) states that policies visited
    threads: int = 1
    previous: bytes | None = None  # model of the previous round, which predicts the new samples
    prior: bytes | None = None  # prior model, such as one learned from a simulator


@dataclass(frozen=True)
class DesignResult:
    """Result of one round of a design. ``model`` is a complete safetensors file: loading it recomputes nothing."""

    model: bytes
    description: dict[str, Any]
    fidelity: dict[str, Any]  # the fields of wire.Fidelity
    data_hash: str
    state: dict[str, Any]
    verdict: Verdict
    seconds: float
    queries: tuple[Query, ...] = ()  # the next queries; the next round begins when they are answered

    @property
    def phase(self) -> Phase:
        """Phase of the design after this round: ``sampling`` if the verdict is ``continue`` or there are next queries,
        else the verdict."""
        return "sampling" if self.verdict == "continue" or self.queries else self.verdict


def run_design_job(job: DesignJob) -> DesignResult:
    """Do one round of a design: fit a model, compute its confidence, choose queries.

    Raises the errors of ``sampling.design.advance``.
    """
    begin = time.perf_counter()
    torch.set_num_threads(job.threads)
    with threadpool_limits(job.threads):  # more threads would slow the small matrix products
        decision, samples = _decide(job)
    with plugin_calls(job.definition):
        model = to_bytes(decision.model)
    return DesignResult(
        model=model,
        description=json.loads(json.dumps(decision.model.description)),  # plug-in types become JSON types
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
    """Compute the confidence of a stored model (safetensors) and the verdict on the design, without a fit.

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
    new = _new_predictions(job, samples)
    if new:
        state = replace(state, predictions=latest(state.predictions, new))
    return advance(job.definition, samples, state, replace(_request(job), surprises=new)), samples


def _new_predictions(job: DesignJob, samples: Samples) -> Predictions:
    """Predict the latest samples by the model of the previous round, which has not learned from them.

    The result is empty if there is no such model, or if it learned from other samples, as an imported model did.
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
            return predicted(model, samples.at(new))
    return ()


def _samples(job: DesignJob) -> Samples:
    """Return the samples of the job that a model can learn from: those whose lag coordinates are all known."""
    return Samples.of(job.samples).at(_is_known(job))


def _is_known(job: DesignJob) -> torch.Tensor:
    """For each of the job's n samples, whether all lag coordinates of the sample's first state are known; (n,) bool."""
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
