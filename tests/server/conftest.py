"""A real server, its client, and a surrogate with a model; definitions of known tasks, and real steps of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
import torch

from support import pendulum
from support.databases import make, postgresql, prepared_file, set_clock_back, storage, until, url  # noqa: F401
from support.real_steps import answer, random_steps
from support.server import ServerProcess
from surrogym_sampler.original import classic
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples

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


@pytest.fixture
def pendulum_definition() -> EnvironmentDefinition:
    return definition_from_spec(classic.pendulum())


@pytest.fixture
def cartpole_definition() -> EnvironmentDefinition:
    return definition_from_spec(classic.cartpole())


@pytest.fixture
def mountain_car_definition() -> EnvironmentDefinition:
    return definition_from_spec(classic.mountain_car_continuous())


@pytest.fixture(scope="session")
def pendulum_samples() -> Samples:
    return random_steps(classic.pendulum(), 20, seed=0)


@pytest.fixture(scope="session")
def half_saturated() -> Samples:
    """Pendulum steps close to the speed limit, where half of them end."""
    rng = torch.Generator().manual_seed(0)
    angle, side, torque = (2 * torch.rand(20, generator=rng, dtype=torch.float64) - 1 for _ in range(3))
    q = torch.stack([torch.pi * angle, 7.6 * side.sign()], -1)
    return answer(classic.pendulum(), q, 2 * torque[:, None])
