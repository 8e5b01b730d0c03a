"""Conversion of policies: requests to records, and records to replies."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from surrogym_server.convert.stored import read_stored
from surrogym_server.features.policies.records import (
    DRIFT,
    OLDER,
    PUSHED_BY,
    EvaluationRecord,
    PolicyFile,
    PolicyRecord,
    judges,
)
from surrogym_server.features.policies.service import Episodes
from surrogym_server.storage.records import JSON
from surrogym_shared import wire
from surrogym_shared.wire.drifts import AddDrift

CARD = "the card of a policy"  # what error messages call the stored description of a policy


def new_policy(body: wire.AddPolicy) -> tuple[JSON, list[JSON], PolicyFile]:
    """Return the card, the learning curve and the announced file of a request that stores a policy."""
    curve = [point.model_dump(mode="json") for point in body.curve]
    return body.card.model_dump(mode="json"), curve, policy_file(body.file)


def policy_file(notice: wire.FileNotice) -> PolicyFile:
    return PolicyFile(notice.form, notice.bytes, notice.digest)


def episodes(body: wire.AddEvaluation) -> Episodes:
    return Episodes(
        body.controller,
        body.note,
        body.declared,
        body.environment,
        body.seeded,
        body.first_seed,
        body.returns,
        body.lengths,
        body.success,
        [trace.model_dump(mode="json") for trace in body.traces],
    )


def policy_list(records: list[PolicyRecord]) -> wire.PolicyList:
    return wire.PolicyList(policies=[policy_view(record) for record in records])


def policy_view(record: PolicyRecord) -> wire.PolicyView:
    return wire.PolicyView(**_fields(record, _card(record)))


def pushed_policy(record: PolicyRecord, *, created: bool) -> wire.PushedPolicy:
    return wire.PushedPolicy(**_fields(record, _card(record)), created=created)


def policy_detail(record: PolicyRecord) -> wire.PolicyDetail:
    """Convert a policy, with the settings and the learning curve of its training, to the reply."""
    card = _card(record)
    curve = [read_stored(wire.CurvePoint, "the curve of a training", point) for point in record.curve]
    of_training = {
        name: getattr(card, name) for name in ("seed", "seconds", "model", "untrained", "settings", "versions")
    }
    return wire.PolicyDetail(**_fields(record, card), **of_training, curve=curve)


def evaluation_view(policy: PolicyRecord, record: EvaluationRecord) -> wire.EvaluationView:
    return read_stored(wire.EvaluationView, "an evaluation", _evaluation(record, _card(policy)))


def evaluation_detail(
    policy: PolicyRecord, record: EvaluationRecord, episodewise: JSON | None, missing: str | None, *, traces: bool
) -> wire.EvaluationDetail:
    """Convert an evaluation with its episodes to the reply.

    ``episodewise`` has the returns, lengths and traces of the episodes. It is None if they can't be read; ``missing``
    then says why. ``traces`` says whether the reply has the traces.
    """
    there = episodewise or {"returns": [], "lengths": [], "success": None, "traces": []}
    fields = {**_evaluation(record, _card(policy)), **there, "missing": missing}
    if not traces:
        fields["traces"] = []
    return read_stored(wire.EvaluationDetail, "an evaluation", fields)


def _card(record: PolicyRecord) -> wire.PushedCard:
    return read_stored(wire.PushedCard, CARD, record.card)


def _fields(record: PolicyRecord, card: wire.PushedCard) -> dict[str, Any]:
    names = ("algorithm", "virtual_steps", "imagined_return", "promise", "audit")
    evaluations = [_evaluation(evaluation, card) for evaluation in record.evaluations]
    drift = _standing(evaluations, record.drifts)
    trusted, reason = _trust(card, evaluations) if drift is None else (False, _words(drift))
    return {
        "version": record.version,
        "created_at": record.created_at,
        "aliases": list(record.aliases),
        **{name: getattr(card, name) for name in names},
        "trusted": trusted,
        "reason": reason,
        "drifted_at": None if drift is None else drift.created_at,
        "differs": record.card.get("differs"),
        "pushed_by": record.card.get(PUSHED_BY),
        "files": [
            {"form": file.form, "bytes": file.bytes, "digest": file.digest, "stored": file.blob is not None}
            for file in record.files
        ],
        "evaluations": evaluations,
    }


def _trust(card: wire.PushedCard, evaluations: list[dict[str, Any]]) -> tuple[bool | None, str]:
    """Return whether a policy's promise (an interval for its mean return) is trusted, with the reason.

    It is not trusted if the mean return in the latest evaluation that can judge the promise is below the interval.
    Otherwise, the policy's card has the answer and the reason.
    """
    latest = _latest(evaluations)
    if latest is None or latest["promise_kept"] or card.promise is None:
        return card.trusted, card.reason
    return False, (
        f"the latest evaluation broke the promise: a mean return of {latest['mean']:.4g}, where at least "
        f"{card.promise.low:.4g} was promised"
    )


def _standing(evaluations: list[dict[str, Any]], drifts: tuple[EvaluationRecord, ...]) -> EvaluationRecord | None:
    """Return the latest report of drift (real steps that no longer agree with the model). Return None if there is none,
    or if a later evaluation can judge the policy's promise."""
    judged, drift = _latest(evaluations), max(drifts, key=lambda one: one.id, default=None)
    return drift if drift is not None and (judged is None or drift.id > int(judged["id"])) else None


def _words(drift: EvaluationRecord) -> str:
    found = read_stored(AddDrift, "a drift", {**drift.summary[DRIFT], "idempotency_key": "-"})
    return f"since {datetime.fromtimestamp(drift.created_at, UTC):%Y-%m-%d %H:%M} UTC, drift: {found.words}"


def _latest(evaluations: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the latest evaluation that can judge the promise (the interval of the return); None if there is none."""
    judged = [one for one in evaluations if one["promise_kept"] is not None]
    return max(judged, key=lambda one: int(one["id"]), default=None)


def _evaluation(record: EvaluationRecord, card: wire.PushedCard) -> dict[str, Any]:
    summary, promise = {**OLDER, **record.summary}, card.promise
    kept = bool(summary["mean"] >= promise.low) if promise is not None and judges(summary) else None
    return {"id": record.id, "created_at": record.created_at, **summary, "promise_kept": kept}
