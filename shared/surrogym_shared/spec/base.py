"""What every model of a specification is built on, and how many entries one may have."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from surrogym_shared.bounded import FailFast

MAX_DIMENSIONS = 64
MAX_TERM_PARTS = 64
MAX_DISCRETE_ACTIONS = 4096
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
NAME_IN_WORDS = "1 to 64 letters, digits, '.', '_' or '-', the first a letter or a digit"
MAX_INEQUALITIES = 16  # in a group, and groups
MAX_ROLLOUT_QUERY = 4_096  # real steps that one query may ask for
MAX_STARTS = 256
REWARD = "reward"

Name = Annotated[str, Field(min_length=1, max_length=64)]


class Frozen(FailFast):
    """Base of every model here: immutable, and unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="null")
