"""The implementations of SurrogatePort that the suite runs over, each with a surrogate of Pendulum."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import pytest

import surrogym_client.errors
import surrogym_server.errors
from surrogym_client.api import Api
from surrogym_client.transport import HttpSurrogate
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_server.surrogate.codec import from_bytes
from surrogym_shared.port import SurrogatePort


@dataclass(frozen=True)
class Harness:
    """``errors`` is the exception tree of the implementation; both trees use the same names."""

    name: str
    port: SurrogatePort
    errors: ModuleType


@pytest.fixture(scope="session")
def http_harness(pendulum_server):
    with HttpSurrogate(pendulum_server.url, "pendulum") as port:
        yield Harness("http", port, surrogym_client.errors)


@pytest.fixture(scope="session")
def local_harness(pendulum_server):
    """The very model that the server serves, exported and loaded into this process."""
    with Api(pendulum_server.url) as api:
        spec, model = api.surrogate("pendulum").spec, api.export_model("pendulum", 1)
    port = LocalSurrogate(spec, from_bytes(definition_from_spec(spec), model))
    return Harness("local", port, surrogym_server.errors)


@pytest.fixture(params=["http", "local"])
def harness(request: pytest.FixtureRequest) -> Harness:
    """One implementation after the other; a new one adds its fixture above, and its name here."""
    return request.getfixturevalue(f"{request.param}_harness")
