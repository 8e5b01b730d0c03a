"""Routes of events: what happens to surrogates, as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from surrogym_server import convert
from surrogym_server.api.auth import READ
from surrogym_server.api.door import DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.storage.records import EventRecord
from surrogym_shared.codes import Code

router = APIRouter(prefix="/v1", tags=["events"], route_class=DoorRoute)

STREAM = "text/event-stream"
CONNECTED, SILENCE = ": connected\n\n", ": still here\n\n"


HEADERS = {"cache-control": "no-store", "x-accel-buffering": "no"}


@router.get(
    "/events",
    summary="Follow whether anything happens",
    response_class=StreamingResponse,
    dependencies=[READ],
    responses={200: {"content": {STREAM: {"example": "event: changed\ndata: {}\n\n"}}}},
)
async def changes(use: Use) -> StreamingResponse:
    """Send an event ``changed`` after a change of any surrogate. Several changes in quick succession make one event.
    Read ``/v1/surrogates`` again after it."""
    return StreamingResponse(_changes(use.events.changes()), media_type=STREAM, headers=HEADERS)


@router.get(
    "/surrogates/{name}/events",
    summary="Follow what happens",
    response_class=StreamingResponse,
    dependencies=[READ],
    responses={
        200: {"content": {STREAM: {"example": 'id: 1\nevent: created\ndata: {"id": 1, "kind": "created"}\n\n'}}},
        **documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
    },
)
async def events(
    name: str,
    use: Use,
    after: Annotated[int | None, Query(ge=0, le=2**63 - 1)] = None,
    last_event_id: Annotated[int | None, Header(ge=0, le=2**63 - 1)] = None,
) -> StreamingResponse:
    """Send queries, samples, fits and phases as they happen. With ``Last-Event-ID`` or ``after`` the stream continues
    after a known event; without either it begins with the next event."""
    newest = await run_in_threadpool(use.events.newest, name)
    start = next((id for id in (last_event_id, after) if id is not None), newest)
    return StreamingResponse(_lines(use.events.follow(name, start)), media_type=STREAM, headers=HEADERS)


async def _changes(changes: AsyncIterator[bool]) -> AsyncIterator[str]:
    yield CONNECTED
    async for changed in changes:
        yield "event: changed\ndata: {}\n\n" if changed else SILENCE


async def _lines(records: AsyncIterator[EventRecord | None]) -> AsyncIterator[str]:
    yield CONNECTED
    async for record in records:
        if record is None:
            yield SILENCE
        else:
            body = convert.event(record).model_dump_json()
            yield f"id: {record.id}\nevent: {record.kind}\ndata: {body}\n\n"
