"""The evidence for a policy's real return: the promise (a predicted interval) and the audit (real steps) of its card,
and its real episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from surrogym_shared.kinds import Side
from surrogym_shared.limits import words_of_fallbacks

if TYPE_CHECKING:
    from surrogym_shared.wire import EvaluationView, PolicyView


class FallbackShare(BaseModel):
    """The predicted share of 100 real episodes in which the fallback of declared limits acts.

    An episode that leaves a limit has a fallback, too, so no larger share of the episodes is expected to leave one.

    Attributes:
        median: median of the prediction.
        low: its 5 % quantile, or the mean if that is less.
        high: its 95 % quantile, or the mean if that is more.
        mean: mean of the prediction, the expected share; None in older cards.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    median: float
    low: float
    high: float
    mean: float | None = None

    def words(self) -> str:
        """Return the expected share and the interval in words."""
        return words_of_fallbacks(self.median if self.mean is None else self.mean, self.low, self.high)


class Promise(BaseModel):
    """The interval in which the surrogate expects the mean return over 100 real starts.

    The expectation is a distribution over starts, and over functions that agree with the samples.

    Attributes:
        median: median of this distribution.
        low: its 5 % quantile.
        high: its 95 % quantile.
        functions: number of drawn functions.
        episodes: number of virtual episodes, over all functions.
        fallback: predicted share of episodes in which the fallback acts; None if the specification has no limits.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    median: float
    low: float
    high: float
    functions: int
    episodes: int
    fallback: FallbackShare | None = None


class RangeLeft(BaseModel):
    """The end of a sampling range that a policy's states exceed most often. The design took no samples beyond it.

    Attributes:
        coordinate: name of the coordinate.
        side: whether it is the lower or the upper end.
        end: value of this end.
        share: share of the policy's states beyond it.
        farthest: the value farthest beyond it.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    coordinate: str
    side: Side
    end: float
    share: float
    farthest: float


class Audit(BaseModel):
    """The result of an audit: real steps on the policy's states, compared with the model.

    Attributes:
        steps: number of real steps.
        elsewhere: number of these steps that were taken in gaps of the samples, in states that the policy does not
            visit.
        episodes: number of whole episodes that the steps form; 0 if they are single steps or a part of an episode.
        rollouts: number of rollouts from resets that were requested for the steps; 0 if they are single steps.
        untested: share of the policy's states that are far from every step of the audit, if states can't be set.
        unanswered: number of further queries, at which the original environment failed.
        untestable: the coordinate that most often prevents the original environment from being set to the policy's
            states, and the share of these states; None if they are few.
        passed: whether the promise is supported.
        faults: what was wrong, one sentence each; empty if the audit passed.
        undeclared: whether a fault is that the machine is not as declared, which no further training changes.
        errors: root mean square of the prediction errors of each output, in the output's unit.
        expected: the errors that the model expected, in the same form.
        before: promise before the audit.
        after: promise of the model that has learned from the audit's steps.
        range_left: the end of a sampling range that the policy exceeds most often; None if it hardly exceeds any.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    steps: int
    elsewhere: int = 0
    episodes: int = 0
    rollouts: int = 0
    untested: float = 0.0
    unanswered: int = 0
    untestable: tuple[str, float] | None = None
    passed: bool
    faults: tuple[str, ...] = ()
    undeclared: bool = False
    errors: dict[str, float] = {}
    expected: dict[str, float] = {}
    before: Promise
    after: Promise
    range_left: RangeLeft | None = None


def chosen_real(policy: PolicyView) -> EvaluationView | None:
    """Return the newest evaluation of the policy in the surrogate's own environment: from the declared starts, or else
    from other ones; None if there is none."""
    own = [one for one in policy.evaluations if one.controller == "policy" and one.own]
    return next((one for one in reversed(own) if one.declared), own[-1] if own else None)
