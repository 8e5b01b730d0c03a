"""Base classes, limits and common types of all requests and replies."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from surrogym_shared.checks import MAX_MEASURED as MAX_MEASURED
from surrogym_shared.fail_fast import FailFast
from surrogym_shared.kinds import AutoresetMode as AutoresetMode
from surrogym_shared.kinds import Variant as Variant
from surrogym_shared.patterns import NAME, VISIBLE
from surrogym_shared.policy_sizes import MAX_ROLLOUT as MAX_ROLLOUT  # re-exported for users of the wire models
from surrogym_shared.spec import MAX_DIMENSIONS
from surrogym_shared.states import Phase as Phase
from surrogym_shared.states import Purpose as Purpose
from surrogym_shared.states import QueryKind as QueryKind
from surrogym_shared.states import QueryStatus as QueryStatus
from surrogym_shared.states import SamplePurpose as SamplePurpose

PROTOCOL = 1
MAX_LANES = 1_048_576
MAX_PARTICLES = 1_000_000
MAX_CLAIM = 256
MAX_BATCH = 65_536
MAX_IMAGINED = 500  # largest number of steps of an imagined (virtual) episode
MAX_DRAWS = 64

Role = Literal["read", "train", "sample", "admin"]

SurrogateName = Annotated[str, Field(pattern=NAME)]
Key = Annotated[str, Field(min_length=1, max_length=128, pattern=VISIBLE)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Seq = Annotated[int, Field(ge=1)]
Measured = Annotated[float, Field(ge=-MAX_MEASURED, le=MAX_MEASURED, allow_inf_nan=False)]
Vector = Annotated[list[Measured], Field(min_length=1, max_length=MAX_DIMENSIONS)]
Matrix = Annotated[list[Vector], Field(min_length=1, max_length=MAX_BATCH)]


class Request(FailFast):
    """Base class of a client's requests. Unknown fields are refused; booleans and strings are not accepted as
    numbers."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Reply(BaseModel):
    """Base class of the server's replies."""

    model_config = ConfigDict(extra="forbid")
