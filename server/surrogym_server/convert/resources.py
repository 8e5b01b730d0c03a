"""Conversion of surrogates, queries, samples, models and events from stored records to replies."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from surrogym_server.convert.sessions import as_tuple, numbers
from surrogym_server.convert.stored import read_stored
from surrogym_server.errors import InvalidInput
from surrogym_server.sampling.uncertainty import UncertaintyResult
from surrogym_server.services.models import Said
from surrogym_server.services.queries import Claim
from surrogym_server.services.samples import Added
from surrogym_server.services.surrogates import Checked, Listed, SurrogateStatus
from surrogym_server.storage.records import (
    EventRecord,
    LeasedQuery,
    LedgerRecord,
    ModelRecord,
    NewSample,
    QueryRecord,
    SampleRecord,
)
from surrogym_server.virtual.imagined import Imagined, ImaginedEpisode
from surrogym_server.virtual.single_step import PointPrediction
from surrogym_shared import spec as wire
from surrogym_shared import wire as replies
from surrogym_shared.nouns import Query, Vector

# Fields of a summary that are sent as they are stored.
SUMMARY_FIELDS = (
    *("name", "environment", "phase", "paused", "round", "model_version", "confidence_index", "target", "budget"),
    "created_at",
)
FIDELITY = "the confidence index with the errors of a model"  # how error messages name a stored fidelity


def surrogate_list(listed: Sequence[Listed], limit: int) -> replies.SurrogateList:
    """Return the page of the first ``limit`` of the ``listed`` surrogates. If more are listed, there is a next page."""
    page, more = listed[:limit], len(listed) > limit
    surrogates = [_summary_fields(one) for one in page]
    return replies.SurrogateList.model_validate(
        {"surrogates": surrogates, "next_after": page[-1].summary.id if more else None}
    )


def surrogate_view(status: SurrogateStatus) -> replies.SurrogateView:
    return replies.SurrogateView(**_view_fields(status))


def created(status: SurrogateStatus, *, created: bool) -> replies.CreatedSurrogate:
    return replies.CreatedSurrogate(**_view_fields(status), created=created)


def checked(name: str, spec: wire.EnvironmentSpec, budget: int, found: Checked) -> replies.CheckedSurrogate:
    return replies.CheckedSurrogate(name=name, spec=spec, budget=budget, target=spec.design.target, **vars(found))


def improved(status: SurrogateStatus, raised: int) -> replies.ImprovedSurrogate:
    return replies.ImprovedSurrogate(**_view_fields(status), budget_raised_by=raised)


def _view_fields(status: SurrogateStatus) -> dict[str, Any]:
    record, model = status.record, status.model
    spec = read_stored(wire.EnvironmentSpec, "a stored specification", record.spec)
    ledger, period = status.summary.ledger, spec.sampling_period
    return {
        **_summary_fields(status),
        "spec": spec,
        "machine_seconds": None if period is None else (ledger.total + ledger.audit) * period,
        "budget_left": status.budget_left,
        "tolerances": record.tolerances,
        "outputs": list(status.outputs),
        "fidelity": None if model is None else read_stored(replies.Fidelity, FIDELITY, model.fidelity),
        "error": status.summary.error,
    }


def _summary_fields(listed: Listed) -> dict[str, Any]:
    summary = listed.summary
    return {
        **{name: getattr(summary, name) for name in SUMMARY_FIELDS},
        "samples": summary.ledger.samples,
        "ledger": _ledger_fields(summary.ledger),
        "queries": vars(summary.queries),
        "samplers": list(listed.samplers),
        "sessions": listed.sessions,
    }


def ledger(record: LedgerRecord) -> replies.Ledger:
    return replies.Ledger(**_ledger_fields(record))


def _ledger_fields(record: LedgerRecord) -> dict[str, int]:
    return {**vars(record), "total": record.total}


def requested(body: replies.AddQueries) -> list[Query]:
    """Return the queries of a request that adds queries: first the single steps, then the rollouts.

    Raises:
        InvalidInput: rows have different lengths, or ``coordinates`` and ``action`` have different numbers of rows.
    """
    q, u = numbers("coordinates", body.coordinates or ()), numbers("action", body.action or ())
    if len(q) != len(u):
        raise InvalidInput(
            f"expected one action for each row of coordinates, got {len(u)} actions and {len(q)} rows of coordinates"
        )
    steps = [Query.step(*step) for step in zip(q.tolist(), u.tolist(), strict=True)]
    policy = None if body.policy is None else _decoded(body.policy)
    return steps + [
        Query.rollout(numbers("rollouts", actions).tolist(), replan=body.replan, policy=policy)
        for actions in body.rollouts or ()
    ]


def trial(body: replies.Trial) -> Query:
    """Return the query of a trial.

    Raises:
        InvalidInput: rows of actions have different lengths, or the policy is not base64.
    """
    return Query.rollout(numbers("actions", body.actions).tolist(), policy=_decoded(body.policy))


def _decoded(policy: str) -> bytes:
    try:
        return b64decode(policy, validate=True)
    except ValueError as error:
        raise InvalidInput(f"policy: expected a policy's file in base64, got other characters: {error}") from error


def claimed(claim: Claim, lease_seconds: float) -> replies.ClaimedQueries:
    queries = [_leased(query, lease_seconds) for query in claim.queries]
    return replies.ClaimedQueries(queries=queries, phase=claim.phase, paused=claim.paused)


def _leased(query: LeasedQuery, lease_seconds: float) -> replies.Query:
    common = {
        "id": query.id,
        "number": query.number,
        "purpose": query.purpose,
        "attempt": query.attempt,
        "lease_token": query.token,
        "lease_seconds": lease_seconds,
    }
    if query.kind == "rollout":
        return replies.RolloutQuery(
            **common,
            actions=_rows(query.actions),
            snapshot=query.snapshot,
            replan=query.replan,
            policy=None if query.policy is None else b64encode(query.policy).decode(),
        )
    return replies.StepQuery(**common, coordinates=list(query.coordinates), action=list(query.action))


def query_list(records: Iterable[QueryRecord]) -> replies.QueryList:
    return replies.QueryList(queries=[query_view(record) for record in records])


def query_view(record: QueryRecord) -> replies.QueryView:
    fields = {"kind": record.kind, "coordinates": record.coordinates or None, "policy": record.policy is not None}
    return replies.QueryView(**vars(record) | fields)


def _rows(actions: Iterable[Vector]) -> list[list[float]]:
    return [list(action) for action in actions]


def new_sample(sample: replies.NewSample) -> NewSample:
    return NewSample(**{key: as_tuple(value) for key, value in sample})


def added_samples(added: Added) -> replies.AddedSamples:
    stored = added.stored
    return replies.AddedSamples(
        sample_ids=list(stored.ids),
        duplicates=stored.duplicates,
        ledger=ledger(added.ledger),
        digest=stored.digest,
        restart=stored.restart,
    )


def snapshot_list(known: Mapping[str, Sequence[float]]) -> replies.SnapshotList:
    views = [replies.SnapshotView(name=name, coordinates=list(at)) for name, at in known.items()]
    return replies.SnapshotList(snapshots=views)


def sample_view(record: SampleRecord) -> replies.SampleView:
    return replies.SampleView.model_validate(record, from_attributes=True)


def sample_page(records: Sequence[SampleRecord], limit: int) -> replies.SamplePage:
    more = len(records) == limit
    return replies.SamplePage(
        samples=[sample_view(record) for record in records], next_after=records[-1].id if more else None
    )


def model_view(record: ModelRecord) -> replies.ModelView:
    fidelity = read_stored(replies.Fidelity, FIDELITY, record.fidelity)
    return replies.ModelView.model_validate(asdict(record) | {"fidelity": fidelity})


def uncertainty(said: Said[UncertaintyResult]) -> replies.Uncertainty:
    result = said.result
    return replies.Uncertainty(
        model_version=said.version,
        outputs=list(said.outputs),
        mean=result.mean.tolist(),
        deviation=result.std.tolist(),
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
        reward_deviation=result.reward_std.tolist(),
        terminated=result.terminated.tolist(),
    )


def imagined(said: Said[Imagined]) -> replies.Imagined:
    result = said.result
    return replies.Imagined(
        model_version=said.version,
        mean=_episode(result.mean),
        draws=[_episode(episode) for episode in result.draws],
    )


def _episode(episode: ImaginedEpisode) -> replies.ImaginedEpisode:
    return replies.ImaginedEpisode(
        coordinates=episode.coordinates.tolist(), reward=episode.reward.tolist(), terminated=episode.terminated
    )


def event(record: EventRecord) -> replies.Event:
    return replies.Event(**asdict(record))
