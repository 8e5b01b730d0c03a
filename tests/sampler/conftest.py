"""A surrogate of a machine that samplers are tried with, on a server of its own process."""

import uuid

import pytest

from support.moody import SPEC
from surrogym_client.transport import Api


@pytest.fixture
def api(server_process):
    with Api(server_process.url) as api:
        yield api


@pytest.fixture
def line(api):
    name = f"line-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(name, SPEC)
    yield name
    api.delete_surrogate(name)
