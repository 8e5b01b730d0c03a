"""A server with a surrogate ``pendulum`` that has a model; the examples run against it as a person would run them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("examples")) as process, Api(process.url) as api:
        teach(api, "pendulum", pendulum(), queries=6)
        yield process
