"""A database that the first schema's program wrote, with a design, its models and an open session: today's program
starts on it, has all of it, and goes on.

``stored/r0001.db.gz`` is the SQLite file that commit 875b34a left when it was stopped, ``r0001.json`` what its API said
before. Of three queries by hand one had failed, one was leased, one was waiting.
"""

from __future__ import annotations

import gzip
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from support import pendulum
from support.server import running_server
from surrogym_client.errors import SpecConflict
from surrogym_client.transport import Api
from surrogym_shared.spec import EnvironmentSpec

STORED = Path(__file__).with_name("stored")
NAME, STEPPED = "pendulum", 3  # steps of the session before the stop
TOLD: dict[str, Any] = json.loads((STORED / "r0001.json").read_text())


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("older")
    (folder / "surrogym.db").write_bytes(gzip.decompress((STORED / "r0001.db.gz").read_bytes()))
    with running_server(folder) as server:
        yield server.url


def test_all_of_it_is_there(url: str):
    with Api(url) as api:
        view, samples = api.surrogate(NAME), list(api.samples(NAME))
        said = api.predict(NAME, [[0.3, -0.2]], [[0.7]])
    assert [sample.model_dump(mode="json", include=set(TOLD["samples"][0])) for sample in samples] == TOLD["samples"]
    assert (view.ledger.total, view.ledger.evaluation) == (len(samples), TOLD["ledger"]["evaluation"])
    assert (view.ledger.unresolved, view.ledger.failed) == (2, 1), "of the attempts that were under way"
    assert said.model_version == view.model_version == TOLD["model_version"]
    np.testing.assert_allclose(said.next_coordinates, TOLD["prediction"]["next_coordinates"], rtol=1e-9)
    np.testing.assert_allclose(said.reward, TOLD["prediction"]["reward"], rtol=1e-9)


def test_its_session_continues(url: str):
    with httpx.Client(base_url=url) as client:
        for action, observation in zip(TOLD["actions"][STEPPED:], TOLD["observations"][STEPPED:], strict=True):
            reply = client.post(f"/v1/sessions/{TOLD['session']}/step", json={"action": action}).raise_for_status()
            np.testing.assert_allclose(reply.json()["observation"], observation, rtol=1e-6)


def test_its_specification_is_the_same_one_though_specifications_have_grown(url: str):
    spec = EnvironmentSpec.model_validate(TOLD["spec"])
    with Api(url) as api:
        assert api.create_surrogate(NAME, spec).ledger.total >= len(TOLD["samples"])
        with pytest.raises(SpecConflict, match="time_limit was created as 200, got 3"):
            api.create_surrogate(NAME, spec.model_copy(update={"time_limit": 3}))


def test_its_design_continues(url: str):
    with httpx.Client(base_url=url, timeout=60) as client:
        before = len(TOLD["samples"])
        pendulum.finish(client, NAME)  # the three by hand
        client.post(f"/v1/surrogates/{NAME}/improve", json={"queries": 1, "idempotency_key": "one"}).raise_for_status()
        while (view := pendulum.finish(client, NAME))["ledger"]["total"] < before + 4:
            time.sleep(0.05)  # until the next fit has chosen it
    assert view["ledger"]["manual"] == 3
    assert view["model_version"] > TOLD["model_version"]
