"""From the route, or from the stream, to the model an action passes no file twice."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from support.way import Way
from surrogym_sampler.original import classic
from surrogym_server.app import create_app
from surrogym_server.engine import sessions
from surrogym_server.engine.design_job import DesignJob, run_design_job
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.settings import Settings
from surrogym_shared import compiled, frames

MODEL = "prediction/compiled/step.py"
STEPS = 2  # until the time of a session's step is known
INLINE_SECONDS = 3_600.0  # a step is taken in the thread that is watched, however busy the machine is
ACTIONS = {"json": 0.1234567, "binary": 0.2345678, "stream": 0.3456789}  # found again by their value

Send = Callable[[Any], Awaitable[None]]


@pytest.fixture
def model(pendulum_definition: EnvironmentDefinition, pendulum_samples: Samples) -> bytes:
    """A file of a model of the Pendulum."""
    samples = pendulum_samples
    arrays = (samples.q, samples.u, samples.q_next, samples.reward, samples.terminated)
    job = DesignJob(pendulum_definition, *(a.numpy() for a in arrays), state={}, budget=len(samples), target=0.999)
    return run_design_job(job).model


@pytest.mark.skipif(not compiled.available(), reason="without numba steps take the way of torch")
def test_an_action_passes_each_file_once(tmp_path: Path, model: bytes, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sessions, "INLINE_SECONDS", INLINE_SECONDS)
    ways = asyncio.run(watched(tmp_path, model))
    for transport, way in ways.items():
        begin = next(i for i, file in enumerate(way.files) if file.startswith("surrogym_server/api/stepping/"))
        files = way.files[begin:]  # what stands before the route has nothing to do with steps
        assert files[-1].endswith(MODEL), transport
        assert len(set(way.down)) == len(way.down), f"{transport}: {way.down}"


async def watched(folder: Path, model: bytes) -> dict[str, Way]:
    app, ways = create_app(Settings(database=str(folder / "db"))), {}
    async with app.router.lifespan_context(app) as state:

        async def served(scope: Any, receive: Any, send: Send) -> None:
            scope["state"] = dict(state or {})
            await app(scope, receive, send)

        async with httpx.AsyncClient(transport=httpx.ASGITransport(served), base_url="http://localhost") as client:
            session = await opened(client, model)
            url = f"/v1/sessions/{session}/step"
            for transport, value in ACTIONS.items():
                for _ in range(STEPS):
                    (await client.post(url, json={"action": [[0.5]]})).raise_for_status()
                ways[transport] = way = Way(value, MODEL)
                frame = frames.encode(frames.step_request(None, np.array([[value]]), None, False))
                if transport == "stream":
                    await over_stream(served, session, frame, way)
                    continue
                headers = {"content-type": frames.MEDIA_TYPE}
                sent = (
                    {"json": {"action": [[value]]}} if transport == "json" else {"content": frame, "headers": headers}
                )
                with way.watched():
                    reply = await client.post(url, **sent)
                reply.raise_for_status()
    return ways


async def opened(client: httpx.AsyncClient, model: bytes) -> str:
    """The id of a session of one lane, reset."""
    (
        await client.post("/v1/surrogates", json={"name": "p", "spec": classic.pendulum().model_dump(mode="json")})
    ).raise_for_status()
    headers = {"content-type": "application/octet-stream"}
    (await client.post("/v1/surrogates/p/models", content=model, headers=headers)).raise_for_status()
    view = (await client.post("/v1/surrogates/p/sessions", json={"num_envs": 1, "seed": 0})).raise_for_status().json()
    (await client.post(f"/v1/sessions/{view['id']}/reset", json={})).raise_for_status()
    return str(view["id"])


async def over_stream(served: Any, session: str, frame: bytes, way: Way) -> None:
    """Send a message in the way that the server's WebSocket hands it over."""
    offered: list[Callable[[bytes], bytes | None]] = []
    messages: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
    scope = {
        "type": "websocket",
        "path": f"/v1/sessions/{session}/stream",
        "headers": [(b"host", b"localhost")],
        "query_string": b"",
        "extensions": {"surrogym.prompt": offered.append},
    }
    await messages.put({"type": "websocket.connect"})

    async def send(_: Any) -> None:
        """Nobody is there."""

    serving = asyncio.create_task(served(scope, messages.get, send))
    while not offered:
        await asyncio.sleep(0.001)
    with way.watched():
        reply = offered[0](frame)
    assert reply is not None, "it was answered at once"
    assert isinstance(frames.read_reply(reply), frames.StepReply)
    await messages.put({"type": "websocket.disconnect"})
    await serving
