"""Gymnasium's Pendulum-v1 as an original environment, and a small surrogate of it."""

from __future__ import annotations

import copy
import time
from typing import Any

import gymnasium
import httpx
import numpy as np

from surrogym_server.api.examples import PENDULUM
from surrogym_server.storage.records import NewSample
from surrogym_server.storage.sql import Storage

INITIAL, BUDGET = 5, 7


def spec(**design: Any) -> dict[str, Any]:
    """The specification with a design of so few queries that a fit takes no time worth mentioning."""
    made = copy.deepcopy(PENDULUM)
    made["design"] = {"initial": INITIAL, "budget": BUDGET, "monte_carlo": 64, **design}
    return made


def real_step(coordinates: list[float], action: list[float]) -> dict[str, Any]:
    """One step of the original environment, as the body of a sample."""
    environment = gymnasium.make("Pendulum-v1").unwrapped
    environment.reset()
    environment.state = np.array(coordinates)
    _, reward, terminated, _, _ = environment.step(np.array(action))
    return {
        "coordinates": coordinates,
        "action": action,
        "next_coordinates": [float(x) for x in environment.state],
        "reward": float(reward),
        "terminated": bool(terminated),
    }


def answer(query: dict[str, Any]) -> dict[str, Any]:
    """The sample that answers a claimed query."""
    identity = {"query_id": query["id"], "lease_token": query["lease_token"]}
    return identity | real_step(query["coordinates"], query["action"])


def answer_open(storage: Storage, name: str) -> int:
    """Answer the open queries of a storage's surrogate; returns how many."""
    queries = storage.queries.claim(name, "tester", 100, 60)
    for query in queries:
        step = real_step(list(query.coordinates), list(query.action))
        storage.samples.add(name, "tester", [NewSample(**step, query_id=query.id, lease_token=query.token)])
    return len(queries)


def claim(client: httpx.Client, name: str, **request: Any) -> dict[str, Any]:
    body = {"sampler": "tester", "max_queries": 16, "wait_seconds": 5, **request}
    return client.post(f"/v1/surrogates/{name}/queries:claim", json=body).raise_for_status().json()


def add(client: httpx.Client, name: str, samples: list[dict[str, Any]], **request: Any) -> httpx.Response:
    body = {"sampler": "tester", "samples": samples, **request}
    return client.post(f"/v1/surrogates/{name}/add_sample", json=body)


def teach(client: httpx.Client, name: str, seconds: float = 120.0, **design: Any) -> dict[str, Any]:
    """Create a surrogate and answer its queries until the design is finished; returns its view."""
    body = {"name": name, "spec": spec(**design)}
    client.post("/v1/surrogates", json=body).raise_for_status()
    return finish(client, name, seconds)


def finish(client: httpx.Client, name: str, seconds: float = 120.0) -> dict[str, Any]:
    """Answer queries until the design is finished; returns the surrogate's view."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        claimed = claim(client, name)
        if claimed["queries"]:
            add(client, name, [answer(query) for query in claimed["queries"]]).raise_for_status()
        view = client.get(f"/v1/surrogates/{name}").raise_for_status().json()
        open_queries = view["queries"]["pending"] + view["queries"]["leased"]
        if view["phase"] == "failed":
            raise AssertionError(view["error"])
        if view["phase"] in ("ready", "over_budget", "unsure") and not open_queries:
            return view
    raise AssertionError(f"the design of {name} was not finished after {seconds} s")
