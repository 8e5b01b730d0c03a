"""What an environment returns in place of a real step is named, in words of this program."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surrogym_sampler.original.errors import StepFailed
from surrogym_sampler.queries.sample_conversion import sample_of
from surrogym_shared.nouns import RealStep
from surrogym_shared.wire import StepQuery

STEP = RealStep([0.0, 1.0], [0.5], [0.1, 1.0], reward=1.0)


def converted(step: Any) -> float:
    query = StepQuery.model_construct(id=1, lease_token="t", coordinates=[0.0, 1.0], action=[0.5])
    return sample_of(query, step, 2).reward


@pytest.mark.parametrize(
    ("step", "says"),
    [
        (None, "expected a RealStep from the environment, got None: return a RealStep"),
        ({"reward": 1.0}, "expected a RealStep from the environment, got an object of the type dict"),
        (replace(STEP, reward=None), "expected numbers for the reward of a real step, got None"),
        (
            replace(STEP, reward=1 + 2j),
            "expected numbers for the reward of a real step, got an object of the type comp",
        ),
        (
            replace(STEP, reward=10**400),
            "expected numbers for the reward of a real step, got an object of the type int",
        ),
        (replace(STEP, reward=np.ones(1)), "expected a number for the reward of a real step, got the shape (1,)"),
        (
            replace(STEP, next_coordinates="ab"),
            "expected numbers for next_coordinates of a real step, got an object of",
        ),
        (replace(STEP, next_coordinates=[1.0, [2.0]]), "expected numbers for next_coordinates of a real step, got an"),
        (replace(STEP, next_coordinates=[1.0, np.nan]), "next_coordinates.1: expected a finite number, got nan"),
    ],
)
def test_what_is_no_real_step_is_named(step: Any, says: str):
    assert converted(STEP) == 1.0
    with pytest.raises(StepFailed, match=re.escape(says)):
        converted(step)
