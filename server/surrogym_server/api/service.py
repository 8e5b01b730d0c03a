"""Routes of the service itself: health, readiness, and its documentation."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse

from surrogym_server.api.door import PUBLIC, READ, DoorRoute, Gate, bearer_token
from surrogym_server.api.openapi import HEADERS, describe, page
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_shared.codes import Code
from surrogym_shared.wire import Access, Health, Ready

router = APIRouter(tags=["service"], route_class=DoorRoute)


@router.head("/healthz", include_in_schema=False, dependencies=[PUBLIC])
@router.get("/healthz", summary="Whether the server runs", dependencies=[PUBLIC])
async def healthz(request: Request) -> Health:
    """Return status 200 as long as the server process runs. This needs no token and no database."""
    return Health(version=request.app.version)


@router.head("/readyz", include_in_schema=False, dependencies=[PUBLIC])
@router.get("/readyz", summary="Whether it can work", dependencies=[PUBLIC], responses=documented(Code.UNAVAILABLE))
def readyz(use: Use) -> Ready:
    """Return status 200 if the server can work: its database has the tables and accepts writes. Otherwise the status is
    503. This needs no token, and checks the database at most once a second."""
    use.storage.ping()
    return Ready(status="ready", storage="ok")


@router.get("/v1/access", summary="The role of the caller's token", dependencies=[READ])
async def access(request: Request) -> Access:
    """Return the role of the request's token."""
    gate: Gate = request.app.state.gate
    token = bearer_token(request.scope)
    return Access(role="admin" if gate.open or token is None else gate.role_of(token), tokens=not gate.open)


@router.get("/openapi.json", include_in_schema=False, dependencies=[READ])
async def openapi(request: Request) -> JSONResponse:
    return JSONResponse(describe(request.app))


@router.get("/docs", include_in_schema=False, dependencies=[READ])
async def docs(request: Request) -> HTMLResponse:
    return HTMLResponse(page(describe(request.app)), headers=HEADERS)
