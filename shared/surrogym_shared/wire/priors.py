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

    name: Word = Field(description="name of the parameter")
    value: Measured = Field(description="calibrated value")
    low: Measured = Field(description="lower end of the value's 90 % interval")
    high: Measured = Field(description="upper end of the value's 90 % interval")
    determined: bool = Field(description="whether the real steps narrow the value more than its declared range does")


class PriorAbout(Request):
    """Origin of a prior, a model learned from a simulator. The simulator's errors are given as shares of the standard
    deviation of each coordinate's changes in a step."""

    source: Word = Field(description="name of the simulator or of the surrogate that the prior was made from")
    parameters: Annotated[list[CalibratedParameter], Field(max_length=64)] = Field(
        default_factory=list, description="parameters of the simulator that were calibrated"
    )
    real_steps: int = Field(default=0, ge=0, description="number of real steps that the parameters were calibrated on")
    failed_steps: int = Field(
        default=0,
        ge=0,
        description="number of further real steps that were not used, because the simulator fails there",
    )
    error_before: Share | None = Field(
        default=None, description="error of the simulator with its original values of the parameters"
    )
    error: Share | None = Field(default=None, description="error of the simulator with the calibrated values")
    simulated_steps: int = Field(
        default=0, ge=0, description="number of simulated steps that the prior was learned from"
    )
    confidence_index: Share | None = Field(
        default=None, le=1, description="confidence index of the model that was learned from these simulated steps"
    )


class PriorView(Reply):
    """The prior of a surrogate, if it has one, and what it was made from."""

    awaited: bool = Field(description="whether the design waits for a prior")
    created_at: float | None = Field(
        default=None, description="when the prior was stored, in seconds since 1970; null without a prior"
    )
    about: PriorAbout | None = Field(default=None, description="what the prior was made from; null without a prior")
