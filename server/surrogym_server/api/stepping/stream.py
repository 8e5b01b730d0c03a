"""The WebSocket ``/v1/sessions/{id}/stream``: binary frames of reset, step and rollout, each as one message.

It is plain ASGI, which makes a step fast. Requests are carried out one at a time, and each is answered before the next
is read. The connection may be dropped at any time: the client can continue the session, by its id, on another.

A server that offers the ASGI extension ``EXTENSION`` may pass on a message to the app as it arrives, without waking a
task. If the answer needs no waiting, the answer is sent at once. Other messages take the usual way of ASGI.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextvars import copy_context

from starlette.datastructures import Headers
from starlette.types import Receive, Scope, Send

from surrogym_server.api.door import Gate, bearer_token
from surrogym_server.api.problems import problem_of, response_of
from surrogym_server.api.stepping.forms import AS_FRAME, carried_out, request_in_frame, seconds_left
from surrogym_server.convert import sessions
from surrogym_server.engine.port import SessionEngine
from surrogym_server.errors import SurrogymError
from surrogym_shared import frames

logger = logging.getLogger(__name__)

EXTENSION = "surrogym.prompt"  # name of an ASGI extension: a function to which the app gives its ``Prompt``
Prompt = Callable[[bytes], bytes | None]  # returns the reply to a message; None to receive the message by ASGI


class StepStream:
    """ASGI app of the WebSocket of steps. One call serves one connection."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        engine: SessionEngine = scope["state"]["services"].engine
        id: str = scope["path_params"]["id"]
        await receive()  # the first message of ASGI, "websocket.connect"
        try:
            _admit(scope)
            shape = sessions.session_shape(await engine.describe(id))
            limit = seconds_left(Headers(scope=scope))
        except SurrogymError as error:
            await response_of(problem_of(error))(scope, receive, send)
            return
        await send({"type": "websocket.accept"})
        if (offered := scope.get("extensions", {}).get(EXTENSION)) is not None:
            within = copy_context()  # so that log lines have the id of the connection's request
            offered(lambda content: within.run(_at_once, engine, limit, id, shape, content))
        while (message := await receive())["type"] == "websocket.receive":
            reply = await _reply(engine, limit, id, shape, message.get("bytes"))
            await send({"type": "websocket.send", "bytes": reply})
            await asyncio.sleep(0)  # lets other tasks run, even if more messages of this client have arrived


def _admit(scope: Scope) -> None:
    """Check that the token of a request has the role train or admin. Raises ``Unauthenticated`` if the token is missing
    or unknown, and ``Forbidden`` if it has another role."""
    gate: Gate = scope["app"].state.gate
    gate.check(bearer_token(scope), ("train",))


def _at_once(engine: SessionEngine, limit: float | None, id: str, shape: frames.Shape, content: bytes) -> bytes | None:
    """Answer one message if that needs no waiting; otherwise do nothing and return None.

    ``limit`` is how long the client waits for a reply, in seconds (None: without limit). ``shape`` has the sizes of the
    session's arrays.
    """
    try:
        frame = frames.read_request(content)
    except frames.FrameError:
        return None
    if isinstance(frame, frames.RolloutRequest | frames.PolicyRequest):  # writing the reply to a rollout may take long
        return None
    try:
        request = request_in_frame(frame, id, shape, limit)
        reply = engine.try_now(request)
        return None if reply is None else AS_FRAME[type(request)](reply)
    except Exception as error:
        return _refused(error, frame.seq)


async def _reply(
    engine: SessionEngine, limit: float | None, id: str, shape: frames.Shape, content: bytes | None
) -> bytes:
    """Carry out the request in one message, and return the reply as a frame. An error becomes a reply too."""
    try:
        if content is None:
            raise frames.FrameError(
                "expected a request as a binary message (a frame), got a text message: send a frame"
            )
        frame = frames.read_request(content)
    except frames.FrameError as error:
        return _refusal(error, None)
    try:
        return await carried_out(engine, request_in_frame(frame, id, shape, limit), AS_FRAME)
    except Exception as error:
        return _refused(error, frame.seq)


def _refused(error: Exception, seq: int | None) -> bytes:
    if not isinstance(error, SurrogymError | frames.FrameError):
        logger.exception("a request on the stream failed", exc_info=error)
    return _refusal(error, seq)


def _refusal(error: Exception, seq: int | None) -> bytes:
    problem = problem_of(error)
    return frames.encode(
        frames.ProblemReply(problem.status, problem.code, problem.title, problem.detail, problem.expected_seq, seq)
    )
