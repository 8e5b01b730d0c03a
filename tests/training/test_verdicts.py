"""Checks end a training where nothing can be gained, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from surrogym_trainer.training.verdicts import Imagined, Verdicts


def after(untrained: float, earned: Sequence[float], checks: Sequence[float]) -> Verdicts:
    """Verdicts after episodes of the training, and checks."""
    verdicts = Verdicts(planned=1_000, untrained=Imagined(untrained, untrained, untrained))
    verdicts.saw(earned)
    for number, imagined in enumerate(checks):
        verdicts.at(100 * (number + 1))
        verdicts.check(Imagined(imagined, imagined, imagined))
    return verdicts


def test_training_is_over_once_three_checks_earn_the_most_there_is():
    assert after(20.0, [500.0], [500.0, 500.0, 500.0]).saturated
    assert not after(20.0, [500.0], [500.0, 500.0]).saturated


@pytest.mark.parametrize(
    ("untrained", "earned", "checks"),
    [
        pytest.param(20.0, [500.0], [500.0, 499.0, 500.0, 500.0], id="one check earned less"),
        pytest.param(20.0, [500.0, 500.1], [500.0] * 5, id="some episode earned more"),
        pytest.param(-500.0, [-500.0], [-500.0] * 5, id="nothing is learned yet"),
        pytest.param(0.0, [0.0], [0.0] * 5, id="a policy that stands still"),
        pytest.param(-1_200.0, [-1.0], [-150.0] * 5, id="a plateau"),
        pytest.param(0.0, [10.0], [50.0, 60.0, 70.0, 80.0, 80.0], id="one start, from which each check earns more"),
    ],
)
def test_training_continues_while_more_may_be_earned(untrained: float, earned: list[float], checks: list[float]):
    assert not after(untrained, earned, checks).saturated


def test_training_continues_while_episodes_of_a_check_differ():
    """Long episodes end rarely: a policy soon earns more in checks than any finished episode of the training."""
    verdicts = after(0.0, [10.0], [])
    for number, mean in enumerate([53.0, 51.0, 50.0]):
        verdicts.at(100 * (number + 1))
        verdicts.check(Imagined(mean=mean, many=80.0, most=820.0))
    assert not verdicts.saturated
