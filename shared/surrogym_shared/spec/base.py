"""Base class and limits of all models of a specification."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from surrogym_shared.bounded import FailFast

MAX_DIMENSIONS = 64
MAX_TERM_PARTS = 64
MAX_DISCRETE_ACTIONS = 4096
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
NAME_IN_WORDS = "1 to 64 letters, digits, '.', '_' or '-', the first a letter or a digit"
MAX_INEQUALITIES = 16  # most inequalities in a group, and most groups
MAX_ROLLOUT_QUERY = 4_096  # most real steps of one query
MAX_STARTS = 256
REWARD = "reward"

VISIBLE = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"  # no control characters, because people see the text
Name = Annotated[str, Field(min_length=1, max_length=64, pattern=VISIBLE)]


class Frozen(FailFast):
    """Base class of all models of a specification: immutable, and without unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="null")
