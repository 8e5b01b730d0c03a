"""A controller of reference acts in the same starts as the policy, and one with a memory begins each episode anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surrogym.cli.beside import Beside
from surrogym.cli.errors import CommandError
from surrogym.cli.groups import PolicyReading
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import PolicyMisfit, UnknownEnvironment
from surrogym_sampler.original.loading import make
from surrogym_trainer.evaluation.baselines import load_reference
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies.card import PolicyCard

MODULE = """
import numpy as np

def brake(observation):
    return -observation[2]

def wrong(observation):
    return [0.0, 1.0]

class Counting:
    made = 0

    def __init__(self):
        Counting.made += 1
        self.steps = 0

    def __call__(self, observation):
        self.steps += 1
        return 2.0 if self.steps <= 3 else 0.0
"""


@pytest.fixture(autouse=True)
def controllers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    name = f"controllers_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    return name


def opened():
    return open_episode("Pendulum-v1", make("Pendulum-v1").spec(), lambda: make("Pendulum-v1"))


@pytest.mark.parametrize("parallel", [1, 3])
def test_each_evaluation_episode_gets_a_new_reference_controller(controllers: str, parallel: int) -> None:
    settings = EvaluationSettings(episodes=3, parallel=parallel)
    found = evaluate(load_reference(f"{controllers}:Counting"), opened, settings)
    for trace in found.traces:
        assert trace.action[:, 0].tolist() == [2.0] * 3 + [0.0] * 197
    assert __import__(controllers).Counting.made == 3


def test_a_reference_controller_function_gets_one_observation_at_a_time(controllers: str) -> None:
    found = evaluate(load_reference(f"{controllers}:brake"), opened, EvaluationSettings(episodes=2, parallel=2))
    for trace in found.traces:
        assert trace.action[:, 0] == pytest.approx(np.clip(-trace.coordinates[:-1, 1], -2, 2), abs=1e-5)


def test_an_invalid_reference_controller_is_refused_before_a_real_step(controllers: str, tmp_path: Path) -> None:
    with pytest.raises(PolicyMisfit, match=r"expected actions of shape \(1, 1\)"):
        evaluate(load_reference(f"{controllers}:wrong"), opened, EvaluationSettings(episodes=1))
    with pytest.raises(UnknownEnvironment, match="absent"):
        load_reference(f"{controllers}:absent")
    policy = tmp_path / "policy.zip", PolicyCard(), PolicyReading(), opened
    with pytest.raises(CommandError, match=r"expected a policy file that exists, or package\.module:name"):
        Beside(reference="pid.zip").controllers(*policy)
    with pytest.raises(CommandError, match="expected --reference without --explore"):
        Beside(reference=f"{controllers}:brake").check(EvaluationSettings(explore=0.1))
    found = Beside("zero", f"{controllers}:brake").controllers(*policy)
    assert list(found) == ["policy", "zero", "reference"]
