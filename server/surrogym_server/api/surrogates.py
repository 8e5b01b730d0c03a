"""Routes of surrogates: create, list, describe, change, delete, improve."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from surrogym_server.api import examples
from surrogym_server.api.door import ADMIN, READ, TRAIN, DoorRoute, example, json_up_to, role_of
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.convert import default_budget, resources
from surrogym_shared.codes import Code
from surrogym_shared.wire import (
    CheckedSurrogate,
    CreatedSurrogate,
    CreateSurrogate,
    Improve,
    ImprovedSurrogate,
    PatchSurrogate,
    SurrogateList,
    SurrogateView,
)

router = APIRouter(prefix="/v1/surrogates", tags=["surrogates"], route_class=DoorRoute)

MAX_PAGE = 1_000


@router.post(
    "",
    status_code=201,
    summary="Register an original environment",
    dependencies=[ADMIN],
    openapi_extra=json_up_to(128),
    responses=documented(Code.INVALID_REQUEST, Code.INVALID_SPEC, Code.SPEC_CONFLICT),
)
def create(body: Annotated[CreateSurrogate, example(examples.CREATE)], use: Use) -> CreatedSurrogate:
    """Create a surrogate from a specification, and queue its initial queries. If the surrogate exists with the same
    specification, nothing changes and ``created`` is false; with another specification, the request is refused."""
    spec = body.spec
    budget = default_budget(spec)
    status, created = use.surrogates.create(body.name, spec.model_dump(mode="json"), budget, spec.design.target)
    return resources.created(status, created=created)


@router.post(
    ":check",
    summary="Check a registration",
    dependencies=[ADMIN],
    openapi_extra=json_up_to(128),
    responses=documented(Code.INVALID_REQUEST, Code.INVALID_SPEC, Code.SPEC_CONFLICT),
)
def check(body: Annotated[CreateSurrogate, example(examples.CREATE)], use: Use) -> CheckedSurrogate:
    """Check a registration without storing anything. The reply has the complete specification with all defaults, and
    the number of initial real steps. A body that the registration would refuse is refused here too."""
    spec = body.spec
    budget = default_budget(spec)
    return resources.checked(
        body.name, spec, budget, use.surrogates.check(body.name, spec.model_dump(mode="json"), budget)
    )


@router.get("", summary="List surrogates", dependencies=[READ], responses=documented(Code.INVALID_REQUEST))
def list_all(
    use: Use,
    after: Annotated[int, Query(ge=0, le=2**63 - 1)] = 0,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = MAX_PAGE,
) -> SurrogateList:
    """List surrogates with phase, number of samples and confidence, oldest first, in pages: give ``next_after`` as
    ``after`` for the next page."""
    return resources.surrogate_list(use.surrogates.list(after, limit + 1), limit)


@router.get(
    "/{name}",
    summary="Describe a surrogate",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def get(name: str, use: Use) -> SurrogateView:
    """Return a surrogate's phase, the fidelity of each output (how well the model predicts it), the counts of real
    steps by purpose, and the counts of queries by status."""
    return resources.surrogate_view(use.surrogates.status(name))


@router.patch(
    "/{name}",
    summary="Pause, resume, change budget, target or tolerances",
    dependencies=[ADMIN],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def patch(name: str, body: Annotated[PatchSurrogate, example(examples.PATCH)], use: Use) -> SurrogateView:
    """Change the given fields of a surrogate. A larger budget or target continues a finished design. After a change of
    a tolerance, the server computes the model's confidence again. Resuming a failed design retries it. After a change
    of target or tolerance, or with a lower budget, the design withdraws the queries that it chose by the model and that
    have no real step so far, and chooses new ones."""
    return resources.surrogate_view(use.surrogates.change(name, **dict(body)))


@router.delete(
    "/{name}",
    status_code=204,
    summary="Delete a surrogate",
    dependencies=[ADMIN],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
async def delete(name: str, use: Use) -> Response:
    """Delete a surrogate with its samples, models and sessions. This can't be undone."""
    await use.surrogates.delete(name)
    return Response(status_code=204)


@router.post(
    "/{name}/improve",
    summary="Request more queries from the design",
    dependencies=[TRAIN],
    openapi_extra=json_up_to(512),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.IDEMPOTENCY_CONFLICT, Code.INVALID_REQUEST, Code.BEYOND_BUDGET),
)
def improve(
    name: str, body: Annotated[Improve, example(examples.IMPROVE)], request: Request, use: Use
) -> ImprovedSurrogate:
    """Request more queries from the design. The acquisition chooses them, weighted by the submitted occupancy (states
    that policies visited). With ``trial``, the query is an episode in which a policy acts. The budget must have enough
    real steps left; steps of open queries and of earlier requests count as used. For a token of role ``admin`` the
    budget is raised if needed, and ``budget_raised_by`` is the increase."""
    may_raise = role_of(request.scope) == "admin"
    queries = (body.queries or 0) if body.trial is None else resources.trial(body.trial)
    granted = use.designer.improve(name, queries, body.checkpoint, body.idempotency_key, raise_budget=may_raise)
    return resources.improved(use.surrogates.status(name), granted.raised)
