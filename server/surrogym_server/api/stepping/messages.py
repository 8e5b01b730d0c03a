"""uvicorn's WebSocket, extended to answer messages as they arrive and to limit unfinished messages."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode
from websockets.protocol import State

from surrogym_server.api.problems import closing_reply
from surrogym_server.api.stepping.stream import EXTENSION, Prompt
from surrogym_shared.codes import Code
from surrogym_shared.messages import MASKED, WHOLE_BINARY, Extent, FrameSplitter, apply_mask, header

MAX_FRAMES = 256  # largest number of WebSocket frames in one read, and of fragments of one message


class Unfinished:
    """Counter of the bytes in unfinished messages of all streams together, with their limit ``most``."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.bytes = 0


def prompt(seconds: float, most_together: int) -> type[WebSocketsSansIOProtocol]:
    """Return uvicorn's WebSocket class, extended by ``PromptMessages``, with two limits.

    Args:
        seconds: longest time for a whole message to arrive.
        most_together: largest number of bytes in unfinished messages of all connections together.
    """
    unfinished = Unfinished(most_together)

    class Bounded(PromptMessages):
        _together, _seconds = unfinished, seconds

    return Bounded


class PromptMessages(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, extended so that the app can answer a message in the call that receives it.

    Without this class, each message goes through a queue to a task of ASGI, which takes as long as a small step. A
    message still goes this way if it is not a single binary frame, if the app can't answer it at once, or if the app is
    busy with an earlier message, so that the order of messages is kept. uvicorn's parser receives whole frames only.
    """

    _together = Unfinished(2**28)
    _seconds = 30.0
    _answer: Prompt | None = None
    _oversized = False  # whether a frame is too large; uvicorn refuses it, and the following bytes belong to it
    _waiting = False  # whether the app waits for the next message
    _counted = 0  # bytes of this connection's unfinished message; ``_together`` sums them over all connections
    _timer: asyncio.TimerHandle | None = None

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._frames = FrameSplitter(self.config.ws_max_size, MAX_FRAMES)

    def handle_connect(self, event: Any) -> None:
        super().handle_connect(event)
        if hasattr(self, "scope"):
            offers: dict[str, Any] = self.scope["extensions"]
            offers[EXTENSION] = self._take

    def data_received(self, data: bytes) -> None:
        if not self.handshake_initiated or self._oversized:  # uvicorn handles the handshake and too large frames
            super().data_received(data)
            if not self.handshake_initiated:
                self._refuse_handshake()
            return
        whole = self._frames.split(data)
        if len(whole) > MAX_FRAMES or len(self.frames) > MAX_FRAMES:
            self._end(f"expected at most {MAX_FRAMES} frames in one message and in one read, got more: send fewer")
            return
        for frame, extent in whole:
            self._oversized = extent is None
            if len(whole) > 1 or extent is None or not self._answered(self._answer, frame, extent):
                super().data_received(frame)
        self._count(self._frames.rest_bytes + sum(map(len, self.frames)))

    def connection_lost(self, exc: Exception | None) -> None:
        self._count(0)
        super().connection_lost(exc)

    def send_receive_event_to_app(self) -> None:
        if self.curr_msg_data_type == "text":  # the app refuses text, and uvicorn would log invalid UTF-8
            self.frames = [b"".join(self.frames).decode(errors="replace").encode()]
        super().send_receive_event_to_app()

    async def receive(self) -> Any:
        self._waiting = True
        try:
            return await super().receive()
        finally:
            self._waiting = False

    async def send(self, message: Any) -> None:
        if self.close_sent:  # an invalid frame has closed the connection while the app answered an earlier message
            raise ClientDisconnected
        await super().send(message)
        self.handshake_complete |= self.close_sent  # otherwise uvicorn would log that a refused handshake is incomplete

    def _refuse_handshake(self) -> None:
        """Answer a WebSocket handshake that can't be read. uvicorn would leave the connection open without a reply."""
        wrong = self.conn.handshake_exc
        why = "it is not whole" if wrong is None else wrong.__cause__ or wrong
        self.transport.write(
            closing_reply(Code.INVALID_REQUEST, f"expected a request that opens a stream, got none: {why}", 400)
        )
        self.transport.close()

    def _take(self, answer: Prompt) -> None:
        self._answer = answer

    def _answered(self, answer: Prompt | None, frame: bytes, extent: Extent) -> bool:
        free = self._waiting and self.queue.empty() and not self.frames and self.writable.is_set()
        if answer is None or not free or frame[0] != WHOLE_BINARY or not frame[1] & MASKED:
            return False
        message = apply_mask(frame[extent.payload :], frame[extent.key : extent.payload])
        if self.close_sent or (reply := answer(message)) is None:
            return False
        self.transport.write(b"".join((header(len(reply)), reply)))
        return True

    def _count(self, unfinished: int) -> None:
        """Update the number of bytes in this connection's unfinished message, and the timer for its arrival.

        Closes the connection if the unfinished messages of all connections together are too large.
        """
        if unfinished == self._counted:
            return
        self._together.bytes += unfinished - self._counted
        self._counted = unfinished
        if self._timer is not None and not unfinished:
            self._timer.cancel()
            self._timer = None
        elif self._timer is None and unfinished:
            late = f"expected a whole message within {self._seconds:g} s, got a part of it: send it again"
            self._timer = self.loop.call_later(self._seconds, self._end, late)
        if self._together.bytes > self._together.most:
            self._end(
                f"expected unfinished messages of at most {self._together.most} bytes in all streams together, got "
                "more: try again later"
            )

    def _end(self, reason: str) -> None:
        """Close the connection, and send the reason if the handshake is complete."""
        if self.close_sent or self.transport.is_closing():
            return
        if self.conn.state is State.OPEN:
            self.conn.send_close(CloseCode.POLICY_VIOLATION, reason)
            self.handle_parser_exception()
        else:
            self.transport.close()
