"""Routes of policies: store, list, download, report evaluations and drift, set aliases. Requests become records
here, and records become replies."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response

from surrogym_server.api.door import (
    ADMIN,
    READ,
    TRAIN,
    TRAIN_OR_SAMPLE,
    DoorRoute,
    example,
    holder,
    json_up_to,
    role_of,
)
from surrogym_server.api.problems import documented
from surrogym_server.convert.stored import read_stored
from surrogym_server.feature import part
from surrogym_server.features.policies.records import (
    DRIFT,
    PUSHED_BY,
    EvaluationRecord,
    PolicyFile,
    PolicyRecord,
    judges,
)
from surrogym_server.features.policies.service import PolicyService
from surrogym_server.storage.records import JSON
from surrogym_shared import wire
from surrogym_shared.codes import Code
from surrogym_shared.patterns import DIGEST
from surrogym_shared.wire import (
    AddEvaluation,
    AddPolicy,
    AliasName,
    EvaluationDetail,
    EvaluationView,
    FileNotice,
    PolicyDetail,
    PolicyForm,
    PolicyList,
    PolicyView,
    PushedPolicy,
    PutAlias,
)
from surrogym_shared.wire.policies import AddDrift

router = APIRouter(prefix="/v1/surrogates/{name}/policies", tags=["policies"], route_class=DoorRoute)

BINARY = "application/octet-stream"
MEDIA_TYPES = {"mp4": "video/mp4", "gif": "image/gif"}
HEADERS = {"x-content-type-options": "nosniff", "content-security-policy": "default-src 'none'; sandbox"}

Policies = Annotated[PolicyService, part(PolicyService)]
Version = Annotated[int, Path(ge=1, le=2**31 - 1)]
Which = Annotated[str, Path(max_length=32, description="a version, an alias, or latest")]
THERE = (Code.UNKNOWN_SURROGATE, Code.UNKNOWN_POLICY, Code.INVALID_REQUEST)

POLICY_EXAMPLE = {
    "card": {"algorithm": "PPO", "promise": {"median": -150, "low": -170, "high": -135}, "trusted": True},
    "curve": [{"steps": 2048, "imagined_return": -1200}, {"steps": 4096, "imagined_return": -600}],
    "file": {
        "form": "zip",
        "bytes": 148_213,
        "digest": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
    },
}
EVALUATION_EXAMPLE = {
    "note": "2 episodes from seed 10000",
    "first_seed": 10_000,
    "returns": [-141.5, -118.2],
    "lengths": [200, 200],
    "idempotency_key": "evaluation-1",
}
DRIFT_EXAMPLE = {
    "output": "speed",
    "error": 0.0131,
    "words": "speed is +0.0131 off the prediction in the last 14 real steps",
    "steps": 214,
    "idempotency_key": "drift-1",
}
ALIAS_EXAMPLE = {"version": 1}


@router.get("", summary="List policies", dependencies=[READ], responses=documented(*THERE))
def list_all(name: str, policies: Policies) -> PolicyList:
    """List policies, newest first, each with its promise (interval of the return), its files and the statistics of its
    real episodes."""
    return policy_list(policies.list(name))


@router.post(
    "",
    status_code=201,
    summary="Store a policy",
    dependencies=[TRAIN],
    openapi_extra=json_up_to(256),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.SPEC_CONFLICT, Code.INVALID_REQUEST, Code.TOO_LARGE),
)
def add(
    name: str, body: Annotated[AddPolicy, example(POLICY_EXAMPLE)], request: Request, policies: Policies
) -> PushedPolicy:
    """Store a policy's card and learning curve, and announce its file, which follows with ``PUT .../files/{form}``. A
    version never changes: the same file with another card or curve is a new version, and a repeat of all three returns
    the existing version. The trust in the card is not compared, so that a downloaded policy is the stored one. A policy
    for other observations or actions is refused; other differences of its specification are named in ``differs``."""
    record, created = policies.add(name, *new_policy(body), by=holder(request.scope))
    return pushed_policy(record, created=created)


@router.get("/{which}", summary="Describe a policy", dependencies=[READ], responses=documented(*THERE))
def get(name: str, which: Which, policies: Policies) -> PolicyDetail:
    """Return a policy with the settings and the learning curve of its training. ``which`` is a version, an alias, or
    ``latest``."""
    return policy_detail(policies.get(name, which))


@router.delete(
    "/{version}", status_code=204, summary="Delete a policy", dependencies=[ADMIN], responses=documented(*THERE)
)
def delete(name: str, version: Version, policies: Policies) -> Response:
    """Delete a policy with its files, evaluations and aliases. This can't be undone."""
    policies.delete(name, version)
    return Response(status_code=204)


@router.put(
    "/{version}/files/{form}",
    summary="Send a file of a policy",
    dependencies=[TRAIN],
    openapi_extra={
        "requestBody": {"required": True, "content": {BINARY: {"schema": {"type": "string", "format": "binary"}}}}
    },
    responses=documented(*THERE, Code.FORBIDDEN, Code.TOO_LARGE),
)
async def put_file(
    name: str,
    version: Version,
    form: PolicyForm,
    digest: Annotated[str, Query(pattern=DIGEST, description="SHA-256 of the body, as hex")],
    request: Request,
    policies: Policies,
) -> PolicyView:
    """Store the body as a file of a policy. The file's size, digest and format are checked, but it is never loaded. A
    stored file is never replaced, and only the token that stored the version may add files. If the files of a
    surrogate's policies exceed their limit, files of the oldest policies without an alias are removed."""
    content = await request.body()
    file = policy_file(FileNotice(form=form, bytes=max(1, len(content)), digest=digest))
    by = None if role_of(request.scope) == "admin" else holder(request.scope)
    return policy_view(await run_in_threadpool(policies.put_file, name, version, file, content, by))


@router.get(
    "/{which}/files/{form}",
    summary="Download a file of a policy",
    response_class=Response,
    dependencies=[READ],
    responses={200: {"content": {BINARY: {}}}, **documented(*THERE, Code.DAMAGED)},
)
def file(name: str, which: Which, form: PolicyForm, policies: Policies) -> Response:
    """Download a file as it was sent. A program that loads a zip should never unpickle content that it does not
    trust."""
    version, content = policies.file(name, which, form)
    disposition = f'attachment; filename="{name}-{version}.{form}"'
    media_type = MEDIA_TYPES.get(form, BINARY)
    return Response(content, media_type=media_type, headers={**HEADERS, "content-disposition": disposition})


@router.post(
    "/{version}/evaluations",
    status_code=201,
    summary="Report real episodes of a policy",
    dependencies=[TRAIN],
    openapi_extra=json_up_to(4_096),
    responses=documented(*THERE, Code.TOO_LARGE),
)
def evaluate(
    name: str,
    version: Version,
    body: Annotated[AddEvaluation, example(EVALUATION_EXAMPLE)],
    request: Request,
    policies: Policies,
) -> EvaluationView:
    """Report real episodes of a policy, once for each idempotency key. Their real steps are reported separately, by
    ``POST .../ledger``."""
    return evaluation_view(*policies.evaluate(name, version, body, holder(request.scope)))


@router.post(
    "/{version}/drifts",
    status_code=201,
    summary="Report drift",
    dependencies=[TRAIN_OR_SAMPLE],
    responses=documented(*THERE),
)
def report_drift(
    name: str,
    version: Version,
    body: Annotated[AddDrift, example(DRIFT_EXAMPLE)],
    request: Request,
    policies: Policies,
) -> PolicyView:
    """Report that real steps no longer agree with the model (drift), once for each idempotency key. The policy's
    promise is then not trusted until a later evaluation confirms it."""
    drift = body.model_dump(mode="json", exclude={"idempotency_key"})
    return policy_view(policies.report_drift(name, version, drift, body.idempotency_key, holder(request.scope)))


@router.get(
    "/{which}/evaluations/{id}", summary="Read an evaluation", dependencies=[READ], responses=documented(*THERE)
)
def evaluation(
    name: str,
    which: Which,
    id: Annotated[int, Path(ge=1, le=2**63 - 1)],
    policies: Policies,
    traces: Annotated[
        bool, Query(description="whether the reply has traces (states, actions, rewards) of some episodes")
    ] = True,
) -> EvaluationDetail:
    """Return an evaluation with the return of each episode, and traces of some episodes. If these can't be read,
    ``missing`` has the reason."""
    return evaluation_detail(*policies.episodes(name, which, id), traces=traces)


@router.put("/aliases/{alias}", summary="Set an alias of a policy", dependencies=[ADMIN], responses=documented(*THERE))
def put_alias(
    name: str, alias: AliasName, body: Annotated[PutAlias, example(ALIAS_EXAMPLE)], policies: Policies
) -> PolicyView:
    """Set an alias, such as ``production``, to a version of the policies. An existing alias moves to this version."""
    return policy_view(policies.put_alias(name, alias, body.version))


@router.delete(
    "/aliases/{alias}", status_code=204, summary="Remove an alias", dependencies=[ADMIN], responses=documented(*THERE)
)
def drop_alias(name: str, alias: AliasName, policies: Policies) -> Response:
    """Remove an alias of a policy. The policy itself stays."""
    policies.drop_alias(name, alias)
    return Response(status_code=204)


CARD = "the card of a policy"  # what error messages call the stored description of a policy


def new_policy(body: wire.AddPolicy) -> tuple[JSON, list[JSON], PolicyFile]:
    """Return the card, the learning curve and the announced file of a request that stores a policy."""
    curve = [point.model_dump(mode="json") for point in body.curve]
    return body.card.model_dump(mode="json"), curve, policy_file(body.file)


def policy_file(notice: wire.FileNotice) -> PolicyFile:
    return PolicyFile(notice.form, notice.bytes, notice.digest)


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
        "origin": record.origin,
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

    It is not trusted if the mean return in the latest evaluation that can judge the promise is below the interval, or
    if the policy's latest episodes as declared did not keep the limits. Otherwise, the policy's card has the answer and
    the reason.
    """
    as_declared = [one for one in evaluations if one["controller"] == "policy" and one["declared"] and one["own"]]
    limited = [one for one in as_declared if one.get("limits")]
    if limited and not (kept := max(limited, key=lambda one: int(one["id"]))["limits"])["kept"]:
        return False, f"the latest evaluation did not keep the limits: {kept['said']}"
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
    summary, promise = record.summary, card.promise
    kept = bool(summary["mean"] >= promise.low) if promise is not None and judges(summary) else None
    return {"id": record.id, "created_at": record.created_at, **summary, "promise_kept": kept}
