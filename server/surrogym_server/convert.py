"""Wire <-> core, in pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.session import Answer, Session
from surrogym_server.errors import InvalidInput, InvalidSpec
from surrogym_server.sampling.uncertainty import UncertaintyResult
from surrogym_server.services.models import Said
from surrogym_server.services.queries import Claim
from surrogym_server.services.samples import Added
from surrogym_server.services.sessions import Opening
from surrogym_server.services.surrogates import SurrogateStatus
from surrogym_server.storage.records import (
    EventRecord,
    LedgerRecord,
    ModelRecord,
    NewSample,
    QueryRecord,
    SampleRecord,
)
from surrogym_server.surrogate import definition as core
from surrogym_server.surrogate import distributions, terms
from surrogym_server.surrogate.describe import PointPrediction
from surrogym_server.surrogate.recover import ObservationInverse
from surrogym_server.virtual import VirtualSettings
from surrogym_shared import frames
from surrogym_shared import spec as wire
from surrogym_shared import wire as replies
from surrogym_shared.port import ResetResult, StepResult

PENALTY = {"default": 0.0, "paper": 3.0}  # k of eq. 14
MONTE_CARLO = 1024


def definition_from_spec(spec: wire.EnvironmentSpec) -> core.EnvironmentDefinition:
    """The core's view of a specification, every default of its preset resolved.

    Raises:
        InvalidSpec: the preset can't represent this environment.
    """
    names = spec.coordinate_names
    definition = core.EnvironmentDefinition(
        coordinates=tuple(_coordinate(c, spec) for c in spec.coordinates),
        observation_names=spec.observation_names,
        observation_terms=tuple(_term(o.term, names) for o in spec.observation),
        observation_low=tuple(_or(o.low, -math.inf) for o in spec.observation),
        observation_high=tuple(_or(o.high, math.inf) for o in spec.observation),
        action=_action(spec.action),
        termination_groups=tuple(tuple(_inequality(i, names) for i in g) for g in spec.termination),
        time_limit=spec.time_limit,
        reward_timing=spec.reward.timing,
        penalty=_or(spec.reward.penalty, PENALTY[spec.design.preset]),
        tolerances=tuple(spec.tolerances.items()),
        design=_design(spec),
    )
    if definition.design.preset == "paper":
        ObservationInverse.of(definition)
    return definition


def default_budget(spec: wire.EnvironmentSpec) -> int:
    """Real steps the design may take where the specification names none: ten per dimension for the default preset,
    three times the initial design for the paper's (it took 125 and 120 in all after 40 and 50)."""
    if spec.design.budget is not None:
        return spec.design.budget
    initial = _design(spec).initial
    if spec.design.preset == "paper":
        return 3 * initial
    return max(10 * (len(spec.coordinates) + spec.action.size), initial)


def _design(spec: wire.EnvironmentSpec) -> core.DesignDefinition:
    design, paper = spec.design, spec.design.preset == "paper"
    if paper:  # 10 (D + F), section 3.1
        initial = 10 * (len(spec.observation) + spec.action.size)
    else:
        initial = max(4, len(spec.coordinates) + spec.action.size)
    if design.initial is not None:
        initial = design.initial
    if design.budget is not None:
        initial = min(initial, design.budget)
    return core.DesignDefinition(
        preset=design.preset,
        initial=initial,
        acquisition=design.acquisition or "uncertainty_index",
        monte_carlo=design.monte_carlo or MONTE_CARLO,
        seed=design.seed,
    )


def _coordinate(coordinate: wire.Coordinate, spec: wire.EnvironmentSpec) -> core.CoordinateDefinition:
    bounds = coordinate.bounds
    stops = None if bounds is None or bounds.stops is None else spec.coordinate_names.index(bounds.stops)
    return core.CoordinateDefinition(
        name=coordinate.name,
        kind=coordinate.kind,
        sampling=_distribution(coordinate.sampling),
        start=_distribution(spec.start[coordinate.name]),
        low=-math.inf if bounds is None else _or(bounds.low, -math.inf),
        high=math.inf if bounds is None else _or(bounds.high, math.inf),
        stops=stops,
    )


def _distribution(distribution: wire.Uniform | wire.Normal | wire.Fixed) -> distributions.Distribution:
    match distribution:
        case wire.Uniform(low=low, high=high):
            return distributions.Uniform(low, high)
        case wire.Normal(mean=mean, std=std):
            return distributions.Normal(mean, std, *distribution.limits)
        case wire.Fixed(value=value):
            return distributions.Fixed(value)
    raise InvalidSpec(f"unknown distribution {distribution!r}")


def _term(term: wire.Term, names: tuple[str, ...]) -> terms.Term:
    parts = tuple(
        terms.Part(p.function, p.coefficient, tuple(p.weights.get(n, 0.0) for n in names)) for p in term.parts
    )
    return terms.Term(parts, _or(term.low, -math.inf), _or(term.high, math.inf))


def _inequality(inequality: wire.Inequality, names: tuple[str, ...]) -> core.Inequality:
    return core.Inequality(_term(inequality.term, names), inequality.relation, inequality.value)


def _action(action: wire.BoxAction | wire.DiscreteAction | wire.MultiDiscreteAction) -> core.ActionDefinition:
    match action:
        case wire.BoxAction():
            return core.ActionDefinition("box", low=action.low, high=action.high, bins=action.bins)
        case wire.DiscreteAction():
            return core.ActionDefinition("discrete", nvec=(action.n,))
        case wire.MultiDiscreteAction():
            return core.ActionDefinition("multi_discrete", nvec=action.nvec)


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


# Surrogates


def surrogate_summary(status: SurrogateStatus) -> replies.SurrogateSummary:
    return replies.SurrogateSummary(**_summary_fields(status))


def surrogate_view(status: SurrogateStatus) -> replies.SurrogateView:
    record, model = status.record, status.model
    return replies.SurrogateView(
        **_summary_fields(status),
        spec=wire.EnvironmentSpec.model_validate(record.spec),
        budget=record.budget,
        target=record.target,
        outputs=list(status.outputs),
        fidelity=None if model is None else replies.Fidelity.model_validate(model.fidelity),
        ledger=ledger(status.ledger),
        queries=replies.QueryCounts(**asdict(status.queries)),
        error=record.error,
    )


def _summary_fields(status: SurrogateStatus) -> dict[str, Any]:
    record, model = status.record, status.model
    return {
        "name": record.name,
        "environment": record.spec["environment"],
        "phase": record.phase,
        "paused": record.paused,
        "round": record.round,
        "samples": status.samples,
        "model_version": None if model is None else model.version,
        "confidence_index": None if model is None else model.fidelity["confidence_index"],
        "created_at": record.created_at,
    }


def ledger(record: LedgerRecord) -> replies.Ledger:
    return replies.Ledger(**asdict(record), total=record.total)


# Queries and samples


def claimed(claim: Claim, lease_seconds: float) -> replies.ClaimedQueries:
    queries = [
        replies.Query(
            id=query.id,
            purpose=query.purpose,
            coordinates=list(query.coordinates),
            action=list(query.action),
            attempt=query.attempt,
            lease_token=query.token,
            lease_seconds=lease_seconds,
        )
        for query in claim.queries
    ]
    return replies.ClaimedQueries(queries=queries, phase=claim.phase, paused=claim.paused)


def query_list(records: Iterable[QueryRecord]) -> replies.QueryList:
    return replies.QueryList(queries=[query_view(record) for record in records])


def query_view(record: QueryRecord) -> replies.QueryView:
    return replies.QueryView.model_validate(_lists(asdict(record)))


def new_sample(sample: replies.NewSample) -> NewSample:
    return NewSample(**{key: _tuple(value) for key, value in sample})


def added_samples(added: Added) -> replies.AddedSamples:
    return replies.AddedSamples(sample_ids=list(added.ids), duplicates=added.duplicates, ledger=ledger(added.ledger))


def sample_view(record: SampleRecord) -> replies.SampleView:
    fields = _lists(asdict(record))
    return replies.SampleView(**{name: fields[name] for name in replies.SampleView.model_fields})


def sample_page(records: Sequence[SampleRecord], limit: int) -> replies.SamplePage:
    more = len(records) == limit
    return replies.SamplePage(
        samples=[sample_view(record) for record in records], next_after=records[-1].id if more else None
    )


# Models


def model_view(record: ModelRecord) -> replies.ModelView:
    return replies.ModelView.model_validate(asdict(record))


def uncertainty(said: Said[UncertaintyResult]) -> replies.Uncertainty:
    result = said.result
    return replies.Uncertainty(
        model_version=said.version,
        outputs=list(said.outputs),
        mean=result.mean.tolist(),
        deviation=result.deviation.tolist(),
        model_uncertainty=result.model_uncertainty.tolist(),
        input_probability=result.input_probability.tolist(),
        log_uncertainty_index=result.log_uncertainty_index.tolist(),
        uncertainty_index=np.exp(result.log_uncertainty_index).tolist(),
    )


def prediction(said: Said[PointPrediction]) -> replies.Prediction:
    result = said.result
    return replies.Prediction(
        model_version=said.version,
        next_coordinates=result.next_coordinates.tolist(),
        next_observation=result.next_observation.tolist(),
        reward=result.reward.tolist(),
        reward_deviation=result.reward_deviation.tolist(),
        terminated=result.terminated.tolist(),
    )


# Sessions


def opening(request: replies.OpenSession) -> Opening:
    settings = VirtualSettings(
        num_envs=request.num_envs,
        variant=request.variant,
        autoreset_mode=request.autoreset_mode,
        time_limit=request.time_limit,
        penalty=request.penalty or 0.0,
        start_box=request.start_box,
        particles=request.particles,
        propagation=request.propagation,
        weighting=request.weighting,
        spread=request.spread,
    )
    return Opening(
        settings=settings,
        penalty=request.penalty,
        seed=request.seed,
        model=request.model,
        occupancy=request.occupancy,
        key=request.idempotency_key,
    )


def session_view(session: Session, idle_seconds: float) -> replies.SessionView:
    return replies.SessionView(
        id=session.id,
        surrogate=session.surrogate,
        num_envs=session.settings.num_envs,
        variant=session.settings.variant,
        seed=session.seed,
        autoreset_mode=session.settings.autoreset_mode,
        model=session.model,
        model_version=session.versions.tolist(),
        seq=session.seq,
        time_limit=session.settings.time_limit,
        penalty=session.settings.penalty,
        observation_space=_box(session.definition.observation_low, session.definition.observation_high),
        action_space=_action_space(session.definition.action),
        outputs=list(session.definition.outputs),
        idle_seconds=idle_seconds,
    )


def _box(low: Iterable[float], high: Iterable[float]) -> replies.BoxSpace:
    return replies.BoxSpace(
        low=[x if math.isfinite(x) else None for x in low], high=[x if math.isfinite(x) else None for x in high]
    )


def _action_space(action: core.ActionDefinition) -> replies.ActionSpace:
    match action.policy_counts:
        case ():
            return _box(action.low, action.high)
        case (n,) if action.kind != "multi_discrete":
            return replies.DiscreteSpace(n=n)
        case counts:
            return replies.MultiDiscreteSpace(nvec=list(counts))


def numbers(what: str, rows: Sequence[Any]) -> NDArray[np.float64]:
    """Nested lists as an array.

    Raises:
        InvalidInput: rows of different lengths.
    """
    try:
        return np.array(rows, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InvalidInput(f"{what}: expected rows of one length, got different ones") from error


def lane_mask(mask: list[bool] | None) -> NDArray[np.bool_] | None:
    return None if mask is None else np.array(mask, dtype=bool)


def reset_reply(answer: Answer) -> dict[str, Any]:
    """The fields of ``ResetReply``, unchecked: this and ``step_reply`` are on the path of every step."""
    assert isinstance(answer.outcome, ResetResult)
    result = answer.outcome
    return {
        "seq": answer.seq,
        "observation": result.observation.tolist(),
        "model_version": result.model_version.tolist(),
    }


def step_reply(answer: Answer) -> dict[str, Any]:
    """The fields of ``StepReply``."""
    assert isinstance(answer.outcome, tuple)
    return _step_fields(answer.seq, answer.outcome[0])


def rollout_reply(answer: Answer) -> dict[str, Any]:
    """The fields of ``RolloutReply``; its steps all carry the one seq of the request."""
    assert isinstance(answer.outcome, tuple)
    return {"seq": answer.seq, "steps": [_step_fields(answer.seq, step) for step in answer.outcome]}


def session_shape(session: Session) -> frames.Shape:
    """What a session's frames leave out."""
    definition = session.definition
    return frames.Shape(
        lanes=session.settings.num_envs,
        observation=len(definition.observation_names),
        action=definition.action.size,
        outputs=len(definition.outputs),
    )


def reset_frame(answer: Answer) -> frames.ResetReply:
    assert isinstance(answer.outcome, ResetResult)
    return frames.reset_reply(answer.seq, answer.outcome)


def step_frame(answer: Answer) -> frames.StepReply:
    assert isinstance(answer.outcome, tuple)
    return frames.step_reply(answer.seq, answer.outcome[0])


def rollout_frame(answer: Answer) -> frames.RolloutReply:
    assert isinstance(answer.outcome, tuple)
    return frames.rollout_reply(answer.seq, answer.outcome)


def _step_fields(seq: int, step: StepResult) -> dict[str, Any]:
    arrays = {field.name: getattr(step, field.name) for field in fields(StepResult)}
    lists = {name: None if array is None else array.tolist() for name, array in arrays.items()}
    return {"seq": seq, **lists}


def event(record: EventRecord) -> replies.Event:
    return replies.Event(**asdict(record))


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _lists(values: dict[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
