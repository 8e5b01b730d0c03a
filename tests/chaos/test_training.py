"""A PPO training that meets a restart ends with the same policy; one that meets a kill ends too, and says so."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from stable_baselines3 import PPO

from support.chaos import SEED, times
from support.server import RestartingServer
from support.teaching import teach
from surrogym_client.original.classic import pendulum
from surrogym_client.training import TrainProgress, TrainResult, TrainSettings, train
from surrogym_client.training.words import words_of_result
from surrogym_client.transport import Api, HttpSurrogate, Retries

FAULTS = times(short=1, full=10)
LANES, SMALL = 8, {"n_steps": 16, "batch_size": 64, "n_epochs": 2}
STEPS = 4_096 * FAULTS
PATIENT = Retries(seconds=120)

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


class Faults:
    """Ends and starts the server so often at random moments between the first and the last rollout."""

    def __init__(self, server: RestartingServer, sig: int) -> None:
        self.done = 0
        self.after: list[int] = []  # virtual steps of the training at the first rollout behind each fault
        self._server, self._sig = server, sig
        self._rollout = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Faults:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._rollout.set()
        self._thread.join()

    def note(self, now: TrainProgress) -> None:
        if len(self.after) < self.done:
            self.after.append(now.steps)
        self._rollout.set()

    def _run(self) -> None:
        source = random.Random(SEED)
        for _ in range(FAULTS):
            self._rollout.clear()
            self._rollout.wait()
            time.sleep(source.uniform(0, 0.1))
            self._server.stop(self._sig)
            self._server.start()
            self.done += 1


def trained(server: RestartingServer, out: Path, sig: int | None = None) -> TrainResult:
    settings = TrainSettings(
        "PPO", total_steps=STEPS, num_envs=LANES, hyperparameters=SMALL, session={"time_limit": 50}
    )
    with HttpSurrogate(server.url, "pendulum", retries=PATIENT) as port:
        if sig is None:
            return train(port, out, settings)
        with Faults(server, sig) as faults:
            result = train(port, out, settings, faults.note)
    assert len(faults.after) == FAULTS, "the training was under way"
    rollout = LANES * SMALL["n_steps"]  # less than one is left over where a network was given up for another
    assert STEPS - rollout < result.virtual_steps <= STEPS, "it ended"
    return result


def test_a_restart_in_the_middle_changes_no_bit_of_the_policy(server: RestartingServer, tmp_path: Path):
    calm = trained(server, tmp_path / "calm.zip")
    restarted = trained(server, tmp_path / "restarted.zip", signal.SIGTERM)
    ours, theirs = (PPO.load(result.path, device="cpu").policy.state_dict() for result in (restarted, calm))
    for name, parameters in theirs.items():
        assert torch.equal(ours[name], parameters), name
    assert (restarted.imagined_return, restarted.lost_episodes) == (calm.imagined_return, 0)
    assert "cut short" not in words_of_result(restarted)


def test_kills_in_the_middle_are_counted_and_reported(server: RestartingServer, tmp_path: Path):
    killed = trained(server, tmp_path / "killed.zip", signal.SIGKILL)
    lost = LANES * FAULTS
    assert killed.lost_episodes == lost
    assert f"{lost} episodes cut short, because the server lost its sessions" in words_of_result(killed)
    assert f'"lost_episodes": {lost}' in (tmp_path / "killed.json").read_text()
