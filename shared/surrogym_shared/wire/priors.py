"""Wire models of priors: models of what is known of the original environment beforehand, such as a simulator."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surrogym_shared.patterns import VISIBLE
from surrogym_shared.wire.base import Measured, Reply, Request

Share = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Word = Annotated[str, Field(min_length=1, max_length=200, pattern=VISIBLE)]


class CalibratedParameter(Request):
    """A parameter of a simulator, calibrated on real steps."""

    name: Word = Field(description="its name")
    value: Measured = Field(description="calibrated value")
    low: Measured = Field(description="lower end of its 90 % interval")
    high: Measured = Field(description="upper end of its 90 % interval")
    determined: bool = Field(description="whether the real steps say more of it than its range does")


class PriorAbout(Request):
    """Origin of a prior, a model learned from a simulator. The simulator's errors are given as shares of the standard
    deviation of each coordinate's changes in a step."""

    source: Word = Field(description="the simulator, or the surrogate")
    parameters: Annotated[list[CalibratedParameter], Field(max_length=64)] = Field(
        default_factory=list, description="parameters that were calibrated"
    )
    real_steps: int = Field(default=0, ge=0, description="real steps that they were calibrated on")
    error_before: Share | None = Field(default=None, description="error of the simulator with its own values")
    error: Share | None = Field(default=None, description="error with the calibrated values")
    simulated_steps: int = Field(default=0, ge=0, description="steps of the simulator that the prior learned from")


class PriorView(Reply):
    """The prior of a surrogate, if it has one, and what it was made from."""

    awaited: bool = Field(description="whether the design waits for a prior")
    created_at: float | None = Field(default=None, description="when it was set, in seconds since 1970; null: never")
    about: PriorAbout | None = Field(default=None, description="what it was made from; null: there is none")
