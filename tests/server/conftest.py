"""A real server, its client, and a surrogate with a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from support import pendulum
from support.server import ServerProcess

Post = Callable[..., httpx.Response]


@pytest.fixture(scope="session")
def client(server_process: ServerProcess) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server_process.url, timeout=60) as opened:
        yield opened


@pytest.fixture(scope="session")
def taught(client: httpx.Client) -> str:
    """Name of a Pendulum whose design is finished; tests leave it as it is."""
    pendulum.teach(client, "taught")
    return "taught"


@pytest.fixture
def name(request: pytest.FixtureRequest) -> str:
    """A name that no other test uses."""
    return f"test-{abs(hash(request.node.nodeid))}"


@pytest.fixture
def fresh(client: httpx.Client, name: str) -> Iterator[str]:
    """Name of a surrogate whose initial queries are all open."""
    client.post("/v1/surrogates", json={"name": name, "spec": pendulum.spec()}).raise_for_status()
    yield name
    client.delete(f"/v1/surrogates/{name}")


@pytest.fixture
def open_session(client: httpx.Client, taught: str) -> Iterator[Callable[..., dict[str, Any]]]:
    """Opens sessions of the taught surrogate with seed 0, and closes them at the end."""
    opened: list[str] = []

    def open_one(surrogate: str = taught, **request: Any) -> dict[str, Any]:
        reply = client.post(f"/v1/surrogates/{surrogate}/sessions", json={"seed": 0, **request})
        session: dict[str, Any] = reply.raise_for_status().json()
        opened.append(session["id"])
        return session

    yield open_one
    for id in opened:
        client.delete(f"/v1/sessions/{id}")


@pytest.fixture
def session(open_session: Callable[..., dict[str, Any]]) -> str:
    """Id of a session of two lanes, not reset yet."""
    return str(open_session(num_envs=2)["id"])
