"""Evidence for a policy, as its card has it: a promise, and an audit."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from surrogym_shared.kinds import Side


class Promise(BaseModel):
    """Interval of the mean return over 100 real starts, as the surrogate predicts it.

    It is a distribution over starts, and over functions that agree with the samples.

    Attributes:
        median: median of this distribution.
        low: its 5 % quantile.
        high: its 95 % quantile.
        functions: number of drawn functions.
        episodes: number of virtual episodes, over all functions.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    median: float
    low: float
    high: float
    functions: int
    episodes: int


class RangeLeft(BaseModel):
    """Where a policy's way leaves the sampling range, so that the design requested no real step there.

    Attributes:
        coordinate: name of the coordinate.
        side: the end of the range that the way passes.
        end: value of this end.
        share: share of the way's states beyond it.
        farthest: the state farthest beyond it.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    coordinate: str
    side: Side
    end: float
    share: float
    farthest: float


class Audit(BaseModel):
    """Result of an audit.

    Attributes:
        steps: number of real steps.
        elsewhere: how many of them were taken in gaps of the samples, off the policy's way.
        episodes: number of whole episodes that the steps are of; 0 if they are single steps or a part of an episode.
        untested: share of the policy's states that are far from every step of the audit, if states can't be set.
        unanswered: number of further queries, at which the original environment failed.
        untestable: a coordinate that many of the policy's states have beyond what the original environment can be set
            to, and the share of these states; None if they are few.
        passed: whether the promise stands.
        faults: what was wrong, one sentence each; empty if the audit passed.
        errors: root mean square of the prediction errors of each output, in the output's unit.
        expected: the errors that the model expected, in the same form.
        before: promise before the audit.
        after: promise of the model that has learned from the audit's steps.
        range_left: where the policy's way leaves the sampling range most often; None if it hardly does.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    steps: int
    elsewhere: int = 0
    episodes: int = 0
    untested: float = 0.0
    unanswered: int = 0
    untestable: tuple[str, float] | None = None
    passed: bool
    faults: tuple[str, ...] = ()
    errors: dict[str, float] = {}
    expected: dict[str, float] = {}
    before: Promise
    after: Promise
    range_left: RangeLeft | None = None
