"""A server of these tests alone: what the pages say changes what it holds."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """With a surrogate ``pendulum`` that has a model, as the pages suppose."""
    with running_server(tmp_path_factory.mktemp("docs")) as process, Api(process.url) as api:
        teach(api, "pendulum", pendulum(), queries=6)
        yield process
