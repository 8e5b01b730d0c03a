"""Base class and limits of all models of a specification."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import ConfigDict, Field

from surrogym_shared.fail_fast import FailFast
from surrogym_shared.patterns import VISIBLE

MAX_DIMENSIONS = 64
MAX_TERM_PARTS = 64
MAX_DISCRETE_ACTIONS = 4096
MAX_INEQUALITIES = 16  # largest number of inequalities that must hold together (a group), and of groups
MOST_PLANNED = 4  # largest number of coordinates of an environment in which a planner acts
MOST_HORIZON = 200  # largest number of steps of each rollout of a planner
MOST_PLANNED_ENTRIES = 3  # largest number of entries of a continuous action that a planner chooses
LONGEST_ROLLOUT = 200  # largest number of real steps of one query, if a specification gives no number
MAX_ROLLOUT_QUERY = 4_096  # largest number of real steps of one query
MAX_STARTS = 256
REWARD = "reward"

Name = Annotated[str, Field(min_length=1, max_length=64, pattern=VISIBLE)]


class Frozen(FailFast):
    """Base class of all models of a specification: immutable, and without unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="null")


def ends_of(low: float | None, high: float | None) -> tuple[float, float]:
    """Return the ends of a range, with an infinity in place of an end that is None."""
    return -math.inf if low is None else low, math.inf if high is None else high
