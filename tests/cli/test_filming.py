"""The video of an evaluation replaces an older one, and none of its troubles costs the evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surrogym.cli.commands.evaluate import film
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.loading import make
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, Trace
from surrogym_trainer.policies.card import PolicyCard

SHORT = Trace(np.zeros((4, 4)), np.zeros((3, 1)), np.ones(3))
RESULT = Evaluation(np.ones(1), np.array([3]), None, (SHORT,))


def opened():
    return open_episode("CartPole-v1", make("CartPole-v1").spec(), lambda: make("CartPole-v1"))


def test_a_new_evaluation_video_replaces_one_of_another_format(tmp_path: Path) -> None:
    policy = tmp_path / "policy.zip"
    for form in ("mp4", "gif"):
        policy.with_suffix(f".{form}").write_bytes(b"older")
    path = film(policy, "CartPole-v1", PolicyCard(), opened, RESULT, EvaluationSettings(), quiet=True)
    assert path is not None
    assert [found.name for found in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() != b"older"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("support.rail:Rail", "no video: expected support.rail:Rail to have a method picture"),
        ("support.machine:Machine", "no video: KeyError: "),  # its factory fails here
    ],
)
def test_a_failed_evaluation_video_is_reported_without_failing_the_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, expected: str
) -> None:
    policy = tmp_path / "policy.zip"
    assert film(policy, name, PolicyCard(), opened, RESULT, EvaluationSettings(), quiet=False) is None
    assert expected in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
