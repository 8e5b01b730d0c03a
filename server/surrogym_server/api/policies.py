"""Routes of policies: store, list, download, evaluate, name."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response

from surrogym_server import convert
from surrogym_server.api import examples
from surrogym_server.api.auth import ADMIN, READ, TRAIN
from surrogym_server.api.body import example
from surrogym_server.api.caller import holder, role_of
from surrogym_server.api.door import DoorRoute, json_up_to
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_shared.codes import Code
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

router = APIRouter(prefix="/v1/surrogates/{name}/policies", tags=["policies"], route_class=DoorRoute)

BINARY = "application/octet-stream"
MEDIA_TYPES = {"mp4": "video/mp4", "gif": "image/gif"}
HEADERS = {"x-content-type-options": "nosniff", "content-security-policy": "default-src 'none'; sandbox"}

Version = Annotated[int, Path(ge=1, le=2**31 - 1)]
Which = Annotated[str, Path(max_length=32, description="a version, an alias, or latest")]
THERE = (Code.UNKNOWN_SURROGATE, Code.UNKNOWN_POLICY, Code.INVALID_REQUEST)


@router.get("", summary="All policies", dependencies=[READ], responses=documented(*THERE))
def list_all(name: str, use: Use) -> PolicyList:
    """List policies, newest first, each with its promise, its files and the statistics of its real episodes."""
    return convert.policy_list(use.policies.list(name))


@router.post(
    "",
    status_code=201,
    summary="Store a policy",
    dependencies=[TRAIN],
    openapi_extra=json_up_to(256),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.SPEC_CONFLICT, Code.INVALID_REQUEST, Code.TOO_LARGE),
)
def add(name: str, body: Annotated[AddPolicy, example(examples.POLICY)], request: Request, use: Use) -> PushedPolicy:
    """Store a policy's card, the curve of its training, and the form of the file that follows with ``PUT
    .../files/{form}``. A version never changes: the same file with another card or curve is a new version, and a repeat
    of all three returns the version that is there. A policy for other observations or actions is refused; other
    differences of its specification are named in ``differs``."""
    record, created = use.policies.add(name, *convert.new_policy(body), by=holder(request.scope))
    return convert.pushed_policy(record, created=created)


@router.get("/{which}", summary="One policy", dependencies=[READ], responses=documented(*THERE))
def get(name: str, which: Which, use: Use) -> PolicyDetail:
    """Return a policy with the settings and the curve of its training. ``which`` is a version, an alias, or
    ``latest``."""
    return convert.policy_detail(use.policies.get(name, which))


@router.delete(
    "/{version}", status_code=204, summary="Delete a policy", dependencies=[ADMIN], responses=documented(*THERE)
)
def delete(name: str, version: Version, use: Use) -> Response:
    """Delete a policy with its files, evaluations and aliases. This can't be undone."""
    use.policies.delete(name, version)
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
    digest: Annotated[str, Query(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the body, as hex")],
    request: Request,
    use: Use,
) -> PolicyView:
    """Send a file as the body. Its size, digest and outer form are checked; it is never loaded. A file
    that is there is never replaced, and only the token that stored the version adds files to it. If the files of a
    surrogate's policies exceed their limit, the files of the oldest policies without an alias are removed."""
    content = await request.body()
    file = convert.policy_file(FileNotice(form=form, bytes=max(1, len(content)), digest=digest))
    by = None if role_of(request.scope) == "admin" else holder(request.scope)
    return convert.policy_view(await run_in_threadpool(use.policies.put_file, name, version, file, content, by))


@router.get(
    "/{which}/files/{form}",
    summary="A file of a policy",
    response_class=Response,
    dependencies=[READ],
    responses={200: {"content": {BINARY: {}}}, **documented(*THERE, Code.DAMAGED)},
)
def file(name: str, which: Which, form: PolicyForm, use: Use) -> Response:
    """Download a file as it was sent. A program that loads a zip should never unpickle content that it does not
    trust."""
    version, content = use.policies.file(name, which, form)
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
    name: str, version: Version, body: Annotated[AddEvaluation, example(examples.EVALUATION)], use: Use
) -> EvaluationView:
    """Report real episodes, once for each idempotency key. ``POST .../ledger`` counts their real steps separately."""
    return convert.evaluation_view(*use.policies.evaluate(name, version, convert.episodes(body), body.idempotency_key))


@router.get("/{which}/evaluations/{id}", summary="One evaluation", dependencies=[READ], responses=documented(*THERE))
def evaluation(
    name: str,
    which: Which,
    id: Annotated[int, Path(ge=1, le=2**63 - 1)],
    use: Use,
    traces: Annotated[bool, Query(description="whether the reply has traces too; they are most of its bytes")] = True,
) -> EvaluationDetail:
    """Return an evaluation with the return of each episode, and traces of some. ``missing`` says why they can't be
    read."""
    return convert.evaluation_detail(*use.policies.episodes(name, which, id), traces=traces)


@router.put("/aliases/{alias}", summary="Name a policy", dependencies=[ADMIN], responses=documented(*THERE))
def put_alias(name: str, alias: AliasName, body: Annotated[PutAlias, example(examples.ALIAS)], use: Use) -> PolicyView:
    """Let the alias, such as ``production``, point to this version, and no longer to another one."""
    return convert.policy_view(use.policies.put_alias(name, alias, body.version))


@router.delete(
    "/aliases/{alias}", status_code=204, summary="Take a name away", dependencies=[ADMIN], responses=documented(*THERE)
)
def drop_alias(name: str, alias: AliasName, use: Use) -> Response:
    """Remove an alias. The policy itself stays."""
    use.policies.drop_alias(name, alias)
    return Response(status_code=204)
