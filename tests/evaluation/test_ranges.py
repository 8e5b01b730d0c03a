"""The end of a sampling range that a policy's way passes: there the design requested no real step."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_trainer.evaluation.out_of_distribution import LITTLE, range_left
from surrogym_trainer.policies.evidence import Audit, Promise, RangeLeft
from surrogym_trainer.training.handover import Handover
from surrogym_trainer.training.words import words_of_handover

SPEC = pendulum()  # an angle, and a speed that is sampled from -8 to 8


def way(*speeds: float) -> np.ndarray:
    return np.array([[50.0, speed] for speed in speeds])


def test_the_sampling_range_end_that_most_visited_states_exceed_is_reported() -> None:
    left = range_left(SPEC, way(9, 8.5, -10, 0, 1, 2, 3, 4))
    assert left == RangeLeft(coordinate=SPEC.coordinates[1].name, side="upper", end=8.0, share=0.25, farthest=9.0)
    left = range_left(SPEC, way(9, -8.5, -10, 0))
    assert left is not None
    assert (left.side, left.end, left.farthest) == ("lower", -8.0, -10.0)


def test_a_few_visited_states_beyond_the_sampling_range_are_not_reported() -> None:
    states = way(9, *[0.0] * 99)
    assert LITTLE > 0.01
    assert range_left(SPEC, states) is None


@pytest.mark.parametrize("left", [None, RangeLeft(coordinate="speed", side="upper", end=8, share=0.34, farthest=11.2)])
def test_the_result_recommends_a_wider_sampling_range_if_the_policy_leaves_it(left: RangeLeft | None) -> None:
    promise = Promise(median=1, low=0, high=2, functions=32, episodes=256)
    audit = Audit(steps=8, passed=True, before=promise, after=promise, range_left=left)
    *before, last = words_of_handover(Handover(promise, audit, True, "because")).split("\n")
    assert last.startswith("promise, after learning the audit: mean return 1")
    assert len(before) == (left is not None)
    if left is not None:
        assert before[0].startswith("34 % of the policy's states have speed above 8, the end of its sampling range")
        assert before[0].endswith("register under a new name with a range up to 11.2")
