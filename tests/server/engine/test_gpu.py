"""A GPU that is too small for a session, or that fails while a session is stepped.

The server has no GPU. The tests tell it how much memory is free, and let steps of three environments raise errors of
torch.
"""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from support import pendulum
from support.server import ServerProcess, start_server

LANES = 3  # of a session whose steps fail
PROGRAM = f"""
import runpy
import torch
from surrogym_server.engine import requests, session

def failing(whole, lanes_of):
    def call(*given, **named):
        if len(lanes_of(*given)) == {LANES}:
            raise torch.AcceleratorError("CUDA error: unspecified launch failure\\nand more", 719)
        return whole(*given, **named)
    return call

requests.free_bytes = lambda device: 20 * 2**20
session.step = failing(session.step, lambda model, settings, lanes, *rest: lanes)
session.reset = failing(session.reset, lambda definition, settings, lanes, seed, mask: () if seed == 1 else lanes)
session.LaneState.to_arrays = failing(session.LaneState.to_arrays, lambda lanes: lanes)
runpy.run_module("surrogym_server", run_name="__main__")
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    server = start_server(tmp_path_factory.mktemp("gpu"), program=("-c", PROGRAM))
    with httpx.Client(base_url=server.url, timeout=60) as client:
        pendulum.teach(client, "p", budget=5)
    yield server
    if server.process.poll() is None:
        server.stop()


def test_lanes_that_do_not_fit_a_gpu_are_refused_with_the_number_that_fits(server: ServerProcess):
    with httpx.Client(base_url=server.url, timeout=60) as client:
        refused = client.post("/v1/surrogates/p/sessions", json={"num_envs": 60_000})
        assert refused.status_code == 413
        said = refused.json()["detail"]
        assert "in the free memory of the GPU, 20 MiB, got one of 60000 lanes" in said
        most = int(said.split("open at most ")[1].split()[0])
        assert 1_000 < most < 60_000
        for lanes, status in ((most, 201), (most + 1, 413)):
            assert client.post("/v1/surrogates/p/sessions", json={"num_envs": lanes}).status_code == status


def test_a_gpu_that_fails_ends_its_sessions_with_one_sentence_and_loses_nothing_else(server: ServerProcess):
    with httpx.Client(base_url=server.url, timeout=60) as client:
        ours, other = (
            client.post("/v1/surrogates/p/sessions", json={"num_envs": n, "seed": 0}).json()["id"] for n in (LANES, 2)
        )
        for session in (ours, other):
            client.post(f"/v1/sessions/{session}/reset", json={"seq": 1, "seed": 1}).raise_for_status()
        failed = [
            client.post(f"/v1/sessions/{ours}/step", json={"seq": 2, "action": [[0.5]] * LANES}),
            client.post(f"/v1/sessions/{ours}/reset", json={"seq": 2, "seed": 2}),
        ]
        for reply in failed:
            assert reply.status_code == 503
            assert reply.json()["detail"] == (
                "the GPU failed (CUDA error: unspecified launch failure), so this server's sessions can't go on: start "
                "the server again, then open new sessions; samples, models and policies are stored"
            )
        client.post(f"/v1/sessions/{other}/step", json={"seq": 2, "action": [[0.5]] * 2}).raise_for_status()
        assert client.get("/v1/surrogates/p").json()["samples"] > 0
    assert server.stop() == 0
    assert "the GPU failed: CUDA error: unspecified launch failure" in server.log
    assert f"session {ours} is lost: " in server.log
    assert "sessions saved: 2" in server.log, "those of the other test and of two environments"
    assert "Traceback" not in server.log
