"""Wire model of a report of drift: the original environment has changed since its model was learned."""

from __future__ import annotations

from pydantic import Field

from surrogym_shared.wire.base import Key, Measured, Request
from surrogym_shared.wire.policies import Count, Text


class AddDrift(Request):
    """Report that real steps no longer agree with the model, so that the return that a policy's promise predicts is not
    trusted."""

    output: Text = Field(description="name of the output that differs most")
    error: Measured = Field(
        description="mean of real minus predicted values of the output, in its unit; or the root mean square, if the "
        "errors have grown in both directions"
    )
    words: Text = Field(description="the error and the region in which it was found, for people")
    steps: Count = Field(description="number of real steps that were compared with the model until drift was found")
    idempotency_key: Key = Field(description="a repeat with the same key adds nothing")
