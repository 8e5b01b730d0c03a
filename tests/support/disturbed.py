"""A PPO training that is disturbed at random moments, and what has to come of it."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from pathlib import Path

import torch
from stable_baselines3 import PPO

from support.chaos import SEED
from surrogym_client.transport import HttpSurrogate, Retries
from surrogym_trainer.training import TrainProgress, TrainResult, TrainSettings, train

LANES, SMALL = 8, {"n_steps": 16, "batch_size": 64, "n_epochs": 2}
STEPS_PER_FAULT = 4_096
PATIENT = Retries(seconds=600)


class Faults:
    """Strikes so often at random moments between the first and the last rollout."""

    def __init__(self, count: int, strike: Callable[[], None]) -> None:
        self.done = 0
        self.after: list[int] = []  # virtual steps of the training at the first rollout behind each fault
        self._count, self._strike = count, strike
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
        for _ in range(self._count):
            self._rollout.clear()
            self._rollout.wait()
            time.sleep(source.uniform(0, 0.1))
            self._strike()
            self.done += 1


def disturbed_training(url: str, out: Path, faults: int, strike: Callable[[], None] | None = None) -> TrainResult:
    """Train a policy of the surrogate ``pendulum``, with as many steps as that many faults need.

    Args:
        url: of the server.
        out: file of the policy.
        faults: how many there are, or would be.
        strike: makes one; None lets the training be.
    """
    steps = STEPS_PER_FAULT * faults
    settings = TrainSettings(
        "PPO", total_steps=steps, num_envs=LANES, hyperparameters=SMALL, session={"time_limit": 50}
    )
    with HttpSurrogate(url, "pendulum", retries=PATIENT) as port:
        if strike is None:
            return train(port, out, settings)
        with Faults(faults, strike) as struck:
            result = train(port, out, settings, struck.note)
    assert len(struck.after) == faults, "the training was under way"
    rollout = LANES * SMALL["n_steps"]  # less than one is left over where a network was given up for another
    assert steps - rollout < result.virtual_steps <= steps, "it ended"
    return result


def require_same_policy(result: TrainResult, calm: TrainResult) -> None:
    """Require that a training gave what the undisturbed one gave, bit for bit, and lost no episode."""
    ours, theirs = (PPO.load(one.path, device="cpu").policy.state_dict() for one in (result, calm))
    for name, parameters in theirs.items():
        assert torch.equal(ours[name], parameters), name
    assert (result.imagined_return, result.lost_episodes) == (calm.imagined_return, 0)
