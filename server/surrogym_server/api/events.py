"""Routes of events: streams of the changes of surrogates, as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from functools import lru_cache
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import StreamingResponse

from surrogym_server.api.door import READ, DoorRoute, Waiting
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.convert import resources
from surrogym_server.services.events import Page
from surrogym_shared.codes import Code

router = APIRouter(prefix="/v1", tags=["events"], route_class=DoorRoute)

STREAM = "text/event-stream"
CONNECTED, SILENCE = ": connected\n\n", ": still here\n\n"


HEADERS = {"cache-control": "no-store", "x-accel-buffering": "no"}


@router.get(
    "/events",
    summary="Stream that any surrogate has changed",
    response_class=StreamingResponse,
    dependencies=[READ],
    responses={
        200: {"content": {STREAM: {"example": "event: changed\ndata: {}\n\n"}}},
        **documented(Code.TOO_MANY_REQUESTS),
    },
)
async def changes(request: Request, use: Use) -> StreamingResponse:
    """Stream an event ``changed`` after changes of any surrogate. A client should then read ``/v1/surrogates`` again.
    Several changes in quick succession make one event."""
    return _stream(request, _changes(use.events.changes()))


@router.get(
    "/surrogates/{name}/events",
    summary="Stream the events of a surrogate",
    response_class=StreamingResponse,
    dependencies=[READ],
    responses={
        200: {"content": {STREAM: {"example": 'id: 1\nevent: created\ndata: {"id": 1, "kind": "created"}\n\n'}}},
        **documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST, Code.TOO_MANY_REQUESTS),
    },
)
async def events(
    name: str,
    request: Request,
    use: Use,
    after: Annotated[int | None, Query(ge=0, le=2**63 - 1)] = None,
    last_event_id: Annotated[int | None, Header(ge=0, le=2**63 - 1)] = None,
) -> StreamingResponse:
    """Stream the events of a surrogate: queries, samples, fits and phases. With ``Last-Event-ID`` or ``after`` the
    stream begins after the event with this id; without either it begins with the next event. Only the newest events of
    a surrogate are kept."""
    newest = await use.events.newest(name)
    start = next((id for id in (last_event_id, after) if id is not None), newest)
    return _stream(request, _lines(use.events.follow(name, start)))


def _stream(request: Request, lines: AsyncIterator[str]) -> StreamingResponse:
    """Return a streaming response of text lines. Raises ``Overloaded`` if the token of the request has too many open
    streams."""
    streams: Waiting = request.app.state.streams
    streams.require_room(request)

    async def counted() -> AsyncIterator[str]:
        # Counted inside the generator, so that a stream counts only once its reply has begun.
        with streams.count(request):
            yield CONNECTED
            async for text in lines:
                yield text

    return StreamingResponse(counted(), media_type=STREAM, headers=HEADERS)


async def _changes(changes: AsyncIterator[bool]) -> AsyncIterator[str]:
    async for changed in changes:
        yield "event: changed\ndata: {}\n\n" if changed else SILENCE


async def _lines(pages: AsyncIterator[Page | None]) -> AsyncIterator[str]:
    async for page in pages:
        yield SILENCE if page is None else _text(page)


@lru_cache(maxsize=8)
def _text(page: Page) -> str:
    """Return a page of events as the text of an event stream. It is cached, because all streams of a surrogate send the
    same page."""
    return "".join(
        f"id: {record.id}\nevent: {record.kind}\ndata: {resources.event(record).model_dump_json()}\n\n"
        for record in page.events
    )
