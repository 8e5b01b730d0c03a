"""Routes of queries: samplers claim queries, renew their leases and report failures; people add queries."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from surrogym_server.api import examples
from surrogym_server.api.door import READ, SAMPLE, TRAIN, DoorRoute, example, json_up_to, require_present
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.convert import resources
from surrogym_shared.codes import Code
from surrogym_shared.wire import (
    AddQueries,
    AuditModel,
    ClaimedQueries,
    ClaimQueries,
    FailQuery,
    QueryList,
    QueryStatus,
    QueryView,
    RenewLease,
    WithdrawnQueries,
    WithdrawQueries,
)

router = APIRouter(prefix="/v1/surrogates/{name}", tags=["queries"], route_class=DoorRoute)

LEASE_ERRORS = documented(
    Code.UNKNOWN_SURROGATE,
    Code.UNKNOWN_QUERY,
    Code.FOREIGN_LEASE,
    Code.LEASE_EXPIRED,
    Code.INVALID_REQUEST,
)


@router.post(
    "/queries:claim",
    summary="Lease queries to answer",
    dependencies=[SAMPLE],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST, Code.TOO_MANY_REQUESTS),
)
async def claim(
    name: str, body: Annotated[ClaimQueries, example(examples.CLAIM)], request: Request, use: Use
) -> ClaimedQueries:
    """Claim up to ``max_queries`` queries, each of which is leased to one sampler at a time. If no query is open, the
    reply waits for one until ``wait_seconds`` have passed or the design ends."""
    present = partial(require_present, request)
    request.app.state.query_claims.require_room(request)
    with request.app.state.query_claims.count(request):
        claimed = await use.queries.claim(
            name, body.sampler, body.max_queries, body.lease_seconds, body.wait_seconds, present
        )
    return resources.claimed(claimed, body.lease_seconds)


@router.post(
    "/queries/{query_id}:renew",
    status_code=204,
    summary="Renew the lease of a query",
    dependencies=[SAMPLE],
    responses=LEASE_ERRORS,
)
def renew(name: str, query_id: int, body: Annotated[RenewLease, example(examples.RENEW)], use: Use) -> Response:
    """Renew the lease of a query whose real step takes long. The lease then ends ``lease_seconds`` from now."""
    use.queries.renew(name, query_id, body.lease_token, body.lease_seconds)
    return Response(status_code=204)


@router.post("/queries/{query_id}:fail", summary="Report a failed query", dependencies=[SAMPLE], responses=LEASE_ERRORS)
def fail(name: str, query_id: int, body: Annotated[FailQuery, example(examples.FAIL)], use: Use) -> QueryView:
    """End the lease of a query that could not be answered, with an error. Another sampler may then claim the query. A
    query that fails repeatedly is set aside (not leased again), and the design continues without it."""
    return resources.query_view(
        use.queries.fail(name, query_id, body.lease_token, body.error, begun=body.begun, refused=body.refused)
    )


@router.post(
    "/queries",
    status_code=201,
    summary="Add queries of your own",
    dependencies=[SAMPLE],
    openapi_extra=json_up_to(512),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.IDEMPOTENCY_CONFLICT, Code.INVALID_REQUEST),
)
def add_queries(name: str, body: Annotated[AddQueries, example(examples.ADD_QUERIES)], use: Use) -> QueryList:
    """Queue queries of your own behind those of the design. The model learns from their answers too."""
    return resources.query_list(use.queries.add(name, resources.requested(body), body.idempotency_key))


@router.post(
    "/audit",
    status_code=201,
    summary="Request the real steps of an audit",
    dependencies=[TRAIN],
    openapi_extra=json_up_to(512),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.IDEMPOTENCY_CONFLICT, Code.BEYOND_BUDGET, Code.INVALID_REQUEST),
)
def audit(name: str, body: Annotated[AuditModel, example(examples.ADD_QUERIES)], use: Use) -> QueryList:
    """Queue the real steps of an audit, which compares the model with real steps at states that a policy visits. They
    don't count towards the budget, and the model learns from them too."""
    queries = resources.requested(body)
    return resources.query_list(use.queries.add(name, queries, body.idempotency_key, purpose="audit"))


@router.post(
    "/audit:withdraw",
    summary="Remove queries of an audit, or trials",
    dependencies=[TRAIN],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def withdraw(name: str, body: Annotated[WithdrawQueries, example(examples.WITHDRAW)], use: Use) -> WithdrawnQueries:
    """Remove queries of an audit, or trials, given by their ids. A query stays if a sampler may have taken a real step
    of it."""
    return WithdrawnQueries(withdrawn=use.queries.withdraw_audit(name, body.query_ids))


@router.get(
    "/queries",
    summary="List queries",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def list_all(name: str, use: Use, status: Annotated[list[QueryStatus], Query()] = []) -> QueryList:  # noqa: B006
    """List the queries of a surrogate, oldest first. With ``status``, which can be given several times, list only the
    queries that have one of these statuses."""
    return resources.query_list(use.storage.queries.list(name, status))
