"""A PPO training that meets a restart ends with the same policy; one that meets a kill ends too, and says so."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.chaos import times
from support.disturbed import LANES, disturbed_training, require_same_policy
from support.server import RestartingServer
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_trainer.training import TrainResult
from surrogym_trainer.training.words import words_of_result

FAULTS = times(short=1, full=10)
pytestmark = pytest.mark.timeout(3_600)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RestartingServer]:
    server = RestartingServer(tmp_path_factory.mktemp("training"))
    try:
        with Api(server.url) as api:
            teach(api, "pendulum", pendulum(), queries=12)
        yield server
    finally:
        server.stop()


def trained(server: RestartingServer, out: Path, sig: int | None = None) -> TrainResult:
    def strike() -> None:
        server.stop(sig or signal.SIGTERM)
        server.start()

    return disturbed_training(server.url, out, FAULTS, None if sig is None else strike)


def test_a_training_learns_the_same_policy_although_the_server_restarts(server: RestartingServer, tmp_path: Path):
    calm = trained(server, tmp_path / "calm.zip")
    restarted = trained(server, tmp_path / "restarted.zip", signal.SIGTERM)
    require_same_policy(restarted, calm)
    assert "cut short" not in words_of_result(restarted)


def test_a_training_counts_and_reports_kills_of_the_server(server: RestartingServer, tmp_path: Path):
    killed = trained(server, tmp_path / "killed.zip", signal.SIGKILL)
    lost = LANES * FAULTS
    assert killed.lost_episodes == lost
    assert f"{lost} episodes cut short, because the server lost its sessions" in words_of_result(killed)
    assert f'"lost_episodes": {lost}' in (tmp_path / "killed.json").read_text()
