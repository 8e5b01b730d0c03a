"""What the benchmarks measure against: echoes without any work, and a server whose surrogate ``trivial`` does none.

Run as ``servers.py echo PORT`` or ``servers.py surrogym OPTIONS``, the options being those of ``surrogym serve``; or as
``servers.py collecting THRESHOLD serve OPTIONS``: the server as it is, with another threshold of garbage collection.
"""

from __future__ import annotations

import sys
from functools import cache
from typing import Any

import numpy as np

TRIVIAL = "trivial"


async def websocket_echo(scope: Any, receive: Any, send: Any) -> None:
    """Answers each message with as many bytes as the query string says: nothing but uvicorn."""
    reply = b"\0" * int(scope["query_string"])
    await receive()
    await send({"type": "websocket.accept"})
    while (await receive())["type"] == "websocket.receive":
        await send({"type": "websocket.send", "bytes": reply})


def echo_app() -> Any:
    """The WebSocket echo, and the same by HTTP as a Starlette route."""
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route, WebSocketRoute

    async def echo(request: Request) -> Response:
        await request.body()
        return Response(b"\0" * int(request.url.query))

    class Echo:
        __call__ = staticmethod(websocket_echo)

    return Starlette(routes=[Route("/echo", echo, methods=["POST"]), WebSocketRoute("/echo", Echo())])


def serve_echo(port: int) -> None:
    import uvicorn

    uvicorn.run(echo_app(), port=port, log_level="warning", access_log=False, ws_per_message_deflate=False)


def serve_surrogym(options: list[str]) -> None:
    """The server as it is, but for the model of one surrogate: its steps give zeros at once."""
    from surrogym.cli import main
    from surrogym_server.engine import requests
    from surrogym_shared.port import StepResult

    true_step = requests.step_session

    @cache
    def nothing_done(lanes: int, size: int) -> StepResult:
        zeros, flags = np.zeros(lanes), np.zeros(lanes, dtype=bool)
        nobody = np.zeros(0, dtype=np.int64), np.zeros((0, size), dtype=np.float32)
        shown, versions = np.zeros((lanes, size), dtype=np.float32), np.ones(lanes, dtype=np.int64)
        return StepResult(shown, zeros, flags, flags, *nobody, versions, zeros, None)

    def step_session(session: Any, *arguments: Any) -> Any:
        if session.surrogate != TRIVIAL:
            return true_step(session, *arguments)
        return session, nothing_done(len(session.versions), len(session.definition.observation_names))

    requests.step_session = step_session  # type: ignore[assignment]
    sys.argv = ["surrogym", "serve", *options]
    main()


def serve_collecting(threshold: int, arguments: list[str]) -> None:
    """Collect the youngest generation after ``threshold`` new objects; 0: never collect."""
    from surrogym.cli import main
    from surrogym_server.cli import runner

    runner.YOUNG_OBJECTS = threshold
    sys.argv = ["surrogym", *arguments]
    main()


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        serve_echo(int(sys.argv[2]))
    elif sys.argv[1] == "collecting":
        serve_collecting(int(sys.argv[2]), sys.argv[3:])
    else:
        serve_surrogym(sys.argv[2:])
