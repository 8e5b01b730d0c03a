"""The implementations of SurrogatePort that the suite runs over, each with a surrogate of Pendulum."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

import pytest

import surrogym_client.errors
import surrogym_server.errors
from surrogym_client.transport import Api, HttpSurrogate, Transport
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.files import from_bytes
from surrogym_shared.port import SurrogatePort


@dataclass(frozen=True)
class Harness:
    """``errors`` is the exception tree of the implementation; both trees use the same names."""

    name: str
    port: SurrogatePort
    errors: ModuleType


@pytest.fixture(scope="session")
def json_harness(pendulum_server):
    yield from remote_harness(pendulum_server.url, "json")


@pytest.fixture(scope="session")
def binary_harness(pendulum_server):
    yield from remote_harness(pendulum_server.url, "binary")


@pytest.fixture(scope="session")
def stream_harness(pendulum_server):
    yield from remote_harness(pendulum_server.url, "stream")


def remote_harness(url: str, transport: Transport) -> Iterator[Harness]:
    with HttpSurrogate(url, "pendulum", transport=transport) as port:
        yield Harness(transport, port, surrogym_client.errors)


@pytest.fixture(scope="session")
def local_harness(pendulum_server):
    """The very model that the server serves, exported and loaded into this process."""
    with Api(pendulum_server.url) as api:
        spec, model = api.surrogate("pendulum").spec, api.export_model("pendulum", 1)
    port = LocalSurrogate(spec, from_bytes(definition_from_spec(spec), model))
    return Harness("local", port, surrogym_server.errors)


@pytest.fixture(params=["local", "json", "binary", "stream"])
def harness(request: pytest.FixtureRequest) -> Harness:
    """One implementation after the other; a new one adds its fixture above, and its name here."""
    return request.getfixturevalue(f"{request.param}_harness")
