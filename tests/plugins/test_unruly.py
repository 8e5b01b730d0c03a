"""A family of models that breaks the laws ends its own fit or request, in one sentence, and nothing else."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from support import pendulum, unruly
from support.server import ServerProcess, running_server
from surrogym_shared.spec import EnvironmentSpec

INITIAL = pendulum.INITIAL


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    folder = tmp_path_factory.mktemp("unruly")
    info = folder / "unruly-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: unruly\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[surrogym.models]\nunruly = unruly_family:Unruly\n")
    (folder / "unruly_family.py").write_text(Path(unruly.__file__).read_text())
    path = [str(folder), *(entry for entry in sys.path if entry.endswith(("server", "client", "shared")))]
    with running_server(folder, "--fit-seconds", "300", PYTHONPATH=":".join(path)) as running:
        yield running


def taught(server: ServerProcess, mode: str) -> str:
    """A surrogate of the unruly family whose first fit is due; its name."""
    name, spec = mode.replace(".", "-"), EnvironmentSpec.model_validate(pendulum.spec()).model_dump(mode="json")
    spec["design"]["model"] = {"name": "unruly", "settings": {"mode": mode}}
    url = f"{server.url}/v1/surrogates"
    httpx.post(url, json={"name": name, "spec": spec}, timeout=60).raise_for_status()
    claim = {"sampler": "tester", "max_queries": INITIAL}
    for query in httpx.post(f"{url}/{name}/queries:claim", json=claim, timeout=60).raise_for_status().json()["queries"]:
        step = pendulum.real_step(query["coordinates"], query["action"])
        sample = {**step, "terminated": False, "query_id": query["id"], "lease_token": query["lease_token"]}
        added = httpx.post(f"{url}/{name}/add_sample", json={"sampler": "tester", "samples": [sample]}, timeout=60)
        added.raise_for_status()
    return name


def fitted(server: ServerProcess, name: str) -> dict[str, Any]:
    """The surrogate when its fit has ended."""
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        status: dict[str, Any] = httpx.get(f"{server.url}/v1/surrogates/{name}", timeout=60).raise_for_status().json()
        if status["phase"] not in ("collecting", "fitting"):
            return status
        time.sleep(0.1)
    raise AssertionError(f"{name} is not fitted: {server.log[-2000:]}")


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("learn.exit", "the fit failed: the model family 'unruly': SystemExit: 3"),
        ("interrupt", "the fit failed: KeyboardInterrupt"),
        ("learn.cancel", "the fit failed: the model family 'unruly': CancelledError"),
        ("learn.two", "the fit failed: the model family 'unruly': TwoArguments: x: boom"),
        ("nan", "the fit failed: the model family 'unruly': next coordinates: expected finite numbers, got nan"),
    ],
)
def test_a_model_plugin_that_fails_fails_only_its_own_fit(server: ServerProcess, mode: str, said: str):
    status = fitted(server, taught(server, mode))
    assert (status["phase"], status["error"]) == ("failed", said)


def test_deleting_a_surrogate_ends_the_blocked_fit_of_its_model_plugin(server: ServerProcess):
    """Others wait for it, and are fitted once it is deleted."""
    name = taught(server, "learn.block")
    other = taught(server, unruly.ORDERLY)
    time.sleep(2)
    assert httpx.get(f"{server.url}/v1/surrogates/{name}", timeout=60).json()["phase"] == "fitting"
    httpx.delete(f"{server.url}/v1/surrogates/{name}", timeout=60).raise_for_status()
    assert fitted(server, other)["phase"] == "sampling"
    assert f"the fit of {name} is dropped" in server.log


@pytest.mark.parametrize("mode", ["raise", "exit", "interrupt", "shape", "nothing"])
def test_a_request_that_fails_in_a_model_plugin_returns_an_error_naming_it(server: ServerProcess, mode: str):
    name = taught(server, f"served.{mode}")
    assert fitted(server, name)["phase"] == "sampling"
    point = {"coordinates": [[0.1, 0.2]], "action": [[0.5]]}
    with httpx.Client(base_url=f"{server.url}/v1", timeout=60) as client:
        opened = client.post(f"/surrogates/{name}/sessions", json={"num_envs": 2, "seed": 0}).raise_for_status()
        session = opened.json()["id"]
        client.post(f"/sessions/{session}/reset", json={"seq": 1}).raise_for_status()
        for _ in range(3):  # in a thread, and in the event loop
            step = client.post(f"/sessions/{session}/step", json={"seq": 2, "action": [[0.1], [0.2]]})
            for reply in (
                step,
                client.post(f"/surrogates/{name}/predict", json=point),
                client.post(f"/surrogates/{name}/query_uncertainty", json=point),
            ):
                assert (reply.status_code, reply.json()["code"]) == (500, "internal"), reply.text
                assert "the model family 'unruly'" in reply.json()["detail"]
                assert "connection" not in reply.headers, "it stays open"
        assert client.get("/surrogates").status_code == 200
