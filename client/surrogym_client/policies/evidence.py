"""What speaks for a policy, as its card has it: a promise, and an audit of it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Promise(BaseModel):
    """Mean return over 100 real starts, as the surrogate predicts it: a distribution over functions that the samples
    allow, and over starts.

    Attributes:
        median: of that distribution.
        low: its 5 % quantile.
        high: its 95 % quantile.
        functions: how many functions were drawn.
        episodes: how many virtual episodes were run, over all functions.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    median: float
    low: float
    high: float
    functions: int
    episodes: int


class Audit(BaseModel):
    """What an audit found.

    Attributes:
        steps: real steps that it took.
        passed: whether the promise stands.
        faults: what was wrong, a sentence each; empty where it passed.
        errors: root mean square of the prediction errors, by output, in its unit.
        expected: the same, as the model expected it.
        before: the promise before the audit.
        after: the promise of the model that has learned from the audit's steps.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    steps: int
    passed: bool
    faults: tuple[str, ...] = ()
    errors: dict[str, float] = {}
    expected: dict[str, float] = {}
    before: Promise
    after: Promise
