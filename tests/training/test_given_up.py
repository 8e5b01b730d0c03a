"""When a network is given up, by what the episodes of its checks earned."""

from __future__ import annotations

import pytest

from surrogym_trainer.training.verdicts import PATIENT_ROLLOUTS, Imagined, Verdicts

UNTRAINED = Imagined(mean=4.9, many=-0.1, most=97.0)  # three of 64 functions reach the goal by themselves
BEST = 95.0  # that an episode of the training earned


@pytest.mark.parametrize(
    ("measured", "given_up"),
    [
        (Imagined(mean=9.3, many=0.0, most=97.0), True),
        (Imagined(mean=30.0, many=90.0, most=97.0), False),
        (Imagined(mean=4.9, many=90.0, most=97.0), True),
    ],
    ids=["six functions instead of three", "a third of the episodes", "no more in the mean"],
)
def test_network_is_kept_if_a_quarter_of_the_episodes_earns_more(measured: Imagined, given_up: bool):
    verdicts = Verdicts(1_000, UNTRAINED)
    verdicts.saw([BEST])
    for _ in range(PATIENT_ROLLOUTS):
        verdicts.after_rollout()
    verdicts.at(300)
    verdicts.check(measured)
    verdicts.judge()
    assert verdicts.given_up == given_up


def test_saved_policy_that_few_episodes_owe_their_return_to_has_learned_nothing():
    verdicts = Verdicts(1_000, UNTRAINED)
    verdicts.saw([BEST])
    assert verdicts.knows(Imagined(mean=9.3, many=0.0, most=97.0)) == (True, False)
    assert verdicts.knows(Imagined(mean=90.0, many=95.0, most=97.0)) == (True, True)


@pytest.mark.parametrize(("mean", "given_up"), [(0.9, False), (0.3, True)], ids=["most starts", "no other start"])
def test_mean_decides_where_a_quarter_of_the_starts_succeeds_untrained(mean: float, given_up: bool):
    """Three starts in ten are next to the goal, and no episode earns more than 1."""
    untrained = Imagined(mean=0.3, many=1.0, most=1.0)
    verdicts = Verdicts(1_000, untrained)
    verdicts.saw([1.0])
    for _ in range(PATIENT_ROLLOUTS):
        verdicts.after_rollout()
    verdicts.at(300)
    verdicts.check(Imagined(mean=mean, many=1.0, most=1.0))
    verdicts.judge()
    assert verdicts.given_up == given_up
    assert verdicts.knows(Imagined(mean=0.95, many=1.0, most=1.0)) == (True, True)
