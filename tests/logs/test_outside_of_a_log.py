"""A model of a log of one operating region promises nothing to a policy outside of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support import reactor
from support.server import ServerProcess
from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.logs import import_log, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.training.handover import Handover, Subject, hand_over
from surrogym_trainer.training.words import words_of_handover


def handed_over(url: str, log: Path, name: str, spec: EnvironmentSpec) -> Handover:
    import_log(log, register=name, spec=spec, url=url)
    with Api(url) as api, HttpSurrogate(url, name) as port:
        wait_for_model(api, name, 120)
        middle = float(np.mean([spec.action.low, spec.action.high]))  # type: ignore[union-attr]
        return hand_over(Subject(api, name, port, lambda o: np.full((len(o), 1), middle, np.float32)), None)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return reactor.log(runs=6, length=20).write(tmp_path / "log.csv")


def test_a_policy_that_starts_outside_the_log_gets_no_promised_return(server_process: ServerProcess, log: Path) -> None:
    drafted = read_log(log, Options()).spec
    place = next(i for i, c in enumerate(drafted.coordinates) if c.name == "temperature")
    fields = drafted.model_dump(mode="json")
    fields["coordinates"][place] |= {"sampling": {"kind": "uniform", "low": 200.0, "high": 900.0}, "bounds": None}
    fields["start"]["temperature"] = {"kind": "uniform", "low": 700.0, "high": 800.0}
    fields |= {"starts": [], "outside_reward": None}
    found = handed_over(server_process.url, log, "outside-of-log", EnvironmentSpec.model_validate(fields))
    assert found.promise is None
    assert not found.trusted
    assert "lie outside the log, with temperature between" in found.reason
    assert words_of_handover(found).startswith("no promise, not trusted: ")


def test_a_policy_that_stays_within_the_log_gets_an_untrusted_promised_return(
    server_process: ServerProcess, log: Path
) -> None:
    found = handed_over(server_process.url, log, "inside-of-log", read_log(log, Options()).spec)
    assert found.promise is not None
    assert not found.trusted
