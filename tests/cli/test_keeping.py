"""Real episodes are never lost to a server that would not take them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surrogym.cli.commands.evaluate import _keep
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, Trace
from surrogym_trainer.policies.pushing import waiting_path


def episodes(returns: list[float]) -> Evaluation:
    traces = tuple(Trace(np.zeros((2, 2)), np.zeros((1, 1)), np.array([r])) for r in returns)
    return Evaluation(np.array(returns), np.ones(len(returns), dtype=np.int64), None, traces)


@pytest.mark.parametrize(
    ("returns", "named"),
    [([np.inf, -1.0], "reward.0"), ([0.0] * 10_001, "returns")],
    ids=["a return that is not finite", "more episodes than one request holds"],
)
def test_real_episodes_that_the_server_refuses_are_reported_and_not_saved_in_a_file(
    returns: list[float], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    policy = tmp_path / "policy.zip"
    _keep(
        policy, [("policy", episodes(returns))], EvaluationSettings(episodes=len(returns)), "Line-v0", None, quiet=False
    )
    assert f"the server can't store the episodes: {named}" in capsys.readouterr().err
    assert not waiting_path(policy).exists()


def test_real_episodes_that_could_not_be_sent_are_saved_in_a_file_beside_the_policy(tmp_path: Path):
    policy, result = tmp_path / "policy.zip", episodes([-1.0, -2.0])
    _keep(policy, [("policy", result), ("zero", result)], EvaluationSettings(episodes=2), "Line-v0", None, quiet=True)
    assert waiting_path(policy).read_text().count('"controller"') == 2
