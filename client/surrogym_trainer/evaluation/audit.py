"""The audit of a policy: the choice of states that it visits in the model, and the judgement of the model by real steps
there.

All functions are pure.

Shapes: n steps, O outputs, C coordinates, F action entries, K sampled errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import sqrt
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.words import counted
from surrogym_trainer.evaluation.systematic import Inputs, Systematic, columns, systematic
from surrogym_trainer.policies.evidence import Audit, Promise

AUDIT_STEPS = 8
MOST_STEPS = 40  # largest number of real steps of an audit, which takes further steps while its result is undecided
# Probability that an audit (real steps that test the model) fails a right model because of the sizes of its errors.
ALARM = 0.01
# probability that a right model ever fails the test for errors that all steps share, however many steps are taken
SHIFT_ALARM = 0.05
# if errors that all steps share move the return out of the promised (predicted) interval with more than this
# probability, an audit takes more steps and widens the interval
UNDECIDED = 0.05
# an audit fails if the model wrongly predicted, in at least this number of steps, whether the step ends its episode
MISPLACED_ENDS = 2
# an audit passes although a real return, or the return that the model predicts after the audit, lies outside the
# promised interval by up to this share of the policy's gain over an untrained policy
SLACK = 0.1
# two states are far apart if a coordinate differs by more than this multiple of the coordinate's standard deviation
# over the states that the policy visits
FAR = 1.0
# an audit does not support the promised interval of the return if more than this share of the states that the policy
# visits is far from every step of the audit
MOST_UNTESTED = 0.2
# To widen the promised interval of the return, its distribution is represented by this number of quantiles.
QUANTILES = 200
# if the lower half of the promised interval of the return is wider than this share of the policy's gain over an
# untrained policy, more real steps may narrow it
UNSURE = 0.2

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Compared:
    """Real steps together with the model's predictions of them.

    Attributes:
        names: names of the outputs, (O,).
        errors: real minus predicted values (n, O), in each output's unit.
        deviations: standard deviations (n, O) of the model's predictions, without noise.
        expected: error (O,) that is allowed in addition to ``deviations``: the larger of the model's tolerance and its
            error on left-out samples, which includes the noise. For the reward, it is at least the error that matters
            for the return.
        misplaced: number of steps whose termination was predicted wrongly.
        cut_short: whether the steps are rollouts, one of which ended earlier than the model predicted.
        unanswered: number of chosen states at which the original environment failed to take the step.
        rollouts: number of rollouts that were requested; 0 if the steps are single ones.
        broken_off: number of rollouts that stopped after their first steps although their episode had not ended.
        elsewhere: number of steps in states that the policy does not visit; they come last.
        claimed_alone: error (O,) of the model on left-out samples. A tolerance does not enlarge it.
        states: states (n, C) at which the steps began.
        actions: actions (n, F) of the steps.
    """

    names: Sequence[str]
    errors: Array
    deviations: Array
    expected: Array
    misplaced: int = 0
    cut_short: bool = False
    unanswered: int = 0
    rollouts: int = 0
    broken_off: int = 0
    elsewhere: int = 0
    claimed_alone: Array = field(default_factory=lambda: np.zeros(0))
    states: Array = field(default_factory=lambda: np.zeros((0, 0)))
    actions: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def claimed(self) -> Array:
        """The standard deviation (n, O) that is allowed for each error: that of the prediction, and ``expected``, as
        the square root of the sum of their squares."""
        scale: Array = np.sqrt(self.deviations**2 + self.expected**2)
        return scale

    @property
    def surprising(self) -> Bools:
        """Mask (O,) of the outputs with larger errors than chance explains, in states that the policy visits. The
        errors are compared with those that the model itself expects, without any tolerance."""
        on_way = slice(len(self.errors) - self.elsewhere)
        errors, deviations = self.errors[on_way], self.deviations[on_way]
        sums = (errors**2 / (deviations**2 + self.claimed_alone**2)).sum(0)
        beyond: Bools = sums > chi_squared(len(errors), ALARM / errors.shape[1])
        return beyond

    def together(self, spec: EnvironmentSpec, inputs: Inputs) -> Systematic:
        """Test whether the errors in states that the policy visits have a part that all steps share."""
        on_way = slice(len(self.errors) - self.elsewhere)
        return systematic(
            self.names,
            self.errors[on_way],
            self.deviations[on_way],
            self.claimed_alone,
            inputs,
            inputs.at(spec, self.states[on_way], self.actions[on_way]),
        )


@dataclass(frozen=True)
class Consequence:
    """The change of a policy's return that would be caused by the part of the model's errors that all steps of an audit
    share.

    Attributes:
        shifted: the test for such a shared part.
        changes: changes (K,) of the mean return, each caused by one sampled error that agrees with the steps.
        before: promise (interval of the return) before the errors were known.
        slack: distance from the promised interval up to which a return still counts as inside.
    """

    shifted: Systematic
    changes: Array
    before: Promise
    slack: float

    @property
    def beyond(self) -> Bools:
        """Mask (K,) of the sampled errors that would move the return out of the promised interval by more than
        ``slack``."""
        returns = self.before.median + self.changes
        outside: Bools = (returns < self.before.low - self.slack) | (returns > self.before.high + self.slack)
        return outside

    @property
    def undecided(self) -> bool:
        """Whether more steps are needed to decide whether the promise holds."""
        return float(self.beyond.mean()) > UNDECIDED and not self.proven

    @property
    def proven(self) -> bool:
        """Whether the model's errors almost certainly have a part that all steps share, and the return with this part
        lies more likely outside of the promised interval than inside."""
        moved = self.changes[self.changes != 0]
        return self.shifted.evidence >= 1 / SHIFT_ALARM and len(moved) > 0 and self.beyond.sum() > len(moved) / 2

    def fault(self, compared: Compared) -> str | None:
        """Return a sentence about the output whose errors most probably have a shared part, and about the return with
        this part; None if the model is not proven wrong."""
        if not self.proven:
            return None
        worst = int(np.argmax(self.shifted.chances))
        error = float(compared.errors[: len(compared.errors) - compared.elsewhere, worst].mean())
        moved = self.before.median + float(np.median(self.changes[self.changes != 0]))
        return (
            f"{compared.names[worst]}: errors that all steps share, {error:+.3g} on average; with them the policy "
            f"would earn {moved:.4g} instead of {self.before.median:.4g}"
        )

    def widened(self, promise: Promise) -> Promise:
        """Return the promise of a model that has learned from the audit's steps, widened to the returns that the shared
        errors make likely.

        If these errors hardly matter for the return, ``promise`` itself is returned.
        """
        if float(self.beyond.mean()) <= UNDECIDED:
            return promise
        quantiles = (np.arange(QUANTILES) + 0.5) / QUANTILES
        own = np.interp(quantiles, [0.05, 0.5, 0.95], [promise.low, promise.median, promise.high])
        moves = np.where(self.beyond, self.before.median + self.changes - promise.median, 0.0)
        low, median, high = np.quantile(own[:, None] + moves, [0.05, 0.5, 0.95]).tolist()
        return promise.model_copy(update={"low": low, "median": median, "high": high})


def judge(
    compared: Compared,
    before: Promise,
    after: Promise,
    floor: float | None,
    consequence: Consequence | None = None,
) -> Audit:
    """Judge the model by an audit's real steps, and compare the promises before and after them.

    An output is at fault in either of two cases:

    - The sum of its squared errors, each divided by the variance that is allowed for it, is larger than chance
      explains. The bound is a quantile of the chi-squared distribution. The probability that any output of a right
      model exceeds it is about 1 %. Single errors within the tolerance are never a fault.
    - The errors have a part that all steps share, more than chance explains. If this part is added to the model, the
      policy's return leaves the promised interval, see ``Consequence``. A shared part without an effect on the return
      is not a fault.

    A rollout has at most one end, so a single end that was not predicted is a fault. A step that the original
    environment fails to take is a fault, because the policy would need it; so is a rollout that stops.

    Args:
        compared: the real steps with their predictions.
        before: promise before the audit.
        after: promise of the model that has learned from the audit.
        floor: return of an untrained policy; None if it was not measured.
        consequence: effect of the errors together on the return; None if it was not computed.
    """
    n, count = compared.errors.shape
    sums = ((compared.errors / compared.claimed) ** 2).sum(0)
    limit = chi_squared(n, ALARM / count)
    actual, claimed = (np.sqrt((values**2).mean(0)) for values in (compared.errors, compared.claimed))
    faults = [
        f"{name}: errors of {actual[i]:.3g}, where the model expected {claimed[i]:.3g}"
        for i, name in enumerate(compared.names)
        if sums[i] > limit
    ]
    if consequence is not None and (shared := consequence.fault(compared)) is not None:
        faults.append(shared)
    if compared.unanswered:
        faults.insert(0, unanswered(compared.unanswered, compared.rollouts or n + compared.unanswered))
    if compared.broken_off:
        faults.insert(
            0,
            f"{compared.broken_off} of {counted(compared.rollouts, 'rollout')} stopped after the first steps, because "
            "the original environment failed or the sampler ended, so nothing is known of the rest",
        )
    if compared.cut_short:
        faults.append("a rollout ended at a step where the model predicted no end")
    elif compared.misplaced >= MISPLACED_ENDS:
        faults.append(f"{compared.misplaced} of {n} steps ended where the model predicted no end, or the reverse")
    slack = SLACK * max(earned(before, floor), earned(after, floor))
    if not before.low - slack <= after.median <= before.high + slack:
        faults.append(
            f"the promise moved from {before.median:.4g} to {after.median:.4g} after the model learned the audit's "
            "steps"
        )
    return Audit(
        steps=n,
        rollouts=compared.rollouts,
        elsewhere=compared.elsewhere,
        passed=not faults,
        faults=tuple(faults),
        errors=dict(zip(compared.names, actual.tolist(), strict=True)),
        expected=dict(zip(compared.names, claimed.tolist(), strict=True)),
        before=before,
        after=after if consequence is None else consequence.widened(after),
    )


def missed(audit: Audit, returns: Array, floor: float | None) -> Audit:
    """Add a fault to an audit if the returns (k,) of whole real episodes miss the promised interval, and return the
    audit.

    The mean of the returns may lie outside of the interval by two of its standard errors, plus ``SLACK`` times the
    policy's gain over an untrained policy, whose return is ``floor``.
    """
    mean, before = float(returns.mean()), audit.before
    chance = 2 * float(returns.std(ddof=1)) / sqrt(len(returns)) if len(returns) > 1 else 0.0
    slack = SLACK * earned(before, floor) + chance
    if before.low - slack <= mean <= before.high + slack:
        return audit
    fault = (
        f"{len(returns)} whole episode{'s' * (len(returns) > 1)} earned {mean:.4g} on average, where "
        f"{before.low:.4g} to {before.high:.4g} was promised"
    )
    return audit.model_copy(update={"passed": False, "faults": (fault, *audit.faults)})


def untested(spec: EnvironmentSpec, q: Array, audited: Array) -> float:
    """Of the states q (m, C) that a policy visits, return the share that is far from every audited state (n, C).

    Two states are far apart if a coordinate differs by more than ``FAR`` standard deviations over the visited states.
    Actions don't count, so coordinates that repeat earlier ones don't count either.
    """
    q, audited = (np.where(spec.repeats_actions, 0.0, states) for states in (q, audited))
    none = np.zeros((len(q) + len(audited), 0))
    at = on_one_scale(spec, np.concatenate([q, audited]), none, len(q))
    way, known = at[: len(q)], at[len(q) :]
    nearest = np.full(len(way), np.inf)
    for one in known:
        nearest = np.minimum(nearest, np.abs(way - one).max(1))
    return float((nearest > FAR).mean())


def unanswered(count: int, of: int) -> str:
    """Return the sentence that the original environment failed at ``count`` of the ``of`` queries of an audit."""
    return f"the original environment failed at {count} of {of} queries, so nothing is known there"


def disappointed(audit: Audit, floor: float | None, imagined: float | None = None) -> bool:
    """Return whether the model promises clearly less after it has learned from an audit than it did before.

    The policy was chosen by its imagined return, the mean return in the model. If this return depends on what the model
    does not know, the promise before the audit is already lower. So the promise after the audit is compared with the
    larger one of the imagined return and the promise before.

    Args:
        audit: the audit.
        floor: return of an untrained policy; None if it was not measured.
        imagined: imagined return of the policy in its training; None if it was not measured.
    """
    before = audit.before.median if imagined is None else max(audit.before.median, imagined)
    lost = before - audit.after.median
    return lost > SLACK * max(earned(audit.before, floor), earned(audit.after, floor))


def wider(promise: Promise, share: float, floor: float | None) -> bool:
    """Return whether the lower half of a promised interval, from its lower end to its median, is wider than ``share``
    of the policy's gain over an untrained policy, whose return is ``floor``."""
    return not promise.median - promise.low <= share * earned(promise, floor)


def earned(promise: Promise, floor: float | None) -> float:
    """Return the gain of a policy: the distance of its promised median return from ``floor``, the return of an
    untrained policy. Without ``floor``, it is the distance from 0."""
    return abs(promise.median - (floor or 0.0))


def chi_squared(degrees: int, above: float) -> float:
    """Return the value that a chi-squared variable with this number of degrees of freedom exceeds with probability
    ``above`` (Wilson and Hilferty 1931)."""
    z, c = NormalDist().inv_cdf(1 - above), 2 / (9 * degrees)
    return float(degrees * (1 - c + z * sqrt(c)) ** 3)


def places(spec: EnvironmentSpec, q: Array, u: Array, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Choose at most ``count`` of the visited states q (m, C) and their actions u (m, F) for an audit, and return their
    indices.

    Half of the chosen states are drawn at random, so that states where the policy spends much time are chosen often.
    Each further state is the one that is farthest from all chosen so far, so that the choice covers all visited states.
    Distances are in standard deviations of the visited states.
    """
    settable = np.flatnonzero(_settable(spec, q))
    count = min(count, len(settable))
    if not count:
        return settable
    at = on_one_scale(spec, q[settable], u[settable])
    drawn = rng.choice(len(settable), size=(count + 1) // 2, replace=False)
    chosen: list[int] = drawn.tolist()
    nearest = np.min([np.linalg.norm(at - at[i], axis=1) for i in chosen], axis=0)
    while len(chosen) < count:
        farthest = int(np.argmax(nearest))
        chosen.append(farthest)
        nearest = np.minimum(nearest, np.linalg.norm(at - at[farthest], axis=1))
    found: NDArray[np.intp] = settable[chosen]
    return found


def gaps(spec: EnvironmentSpec, q: Array, u: Array, samples: tuple[Array, Array], count: int) -> NDArray[np.intp]:
    """Choose at most ``count`` of the states q (m, C) and actions u (m, F) in the widest gaps of single inputs, and
    return their indices.

    A gap is the distance of a coordinate or an action entry from the nearest of the samples, states (n, C) and actions
    (n, F), as a share of the range of q and u. No sample can show a wall or a threshold inside such a gap.
    """
    settable = np.flatnonzero(_settable(spec, q))
    q, u = q[settable], u[settable]
    circles = [coordinate.kind == "angle" for coordinate in spec.coordinates]
    ranges = np.concatenate([np.where(circles, 2 * np.pi, np.ptp(q, axis=0)), np.ptp(u, axis=0)])
    ranges[ranges == 0] = np.inf

    def away(states: Array, actions: Array) -> Array:
        """Return how far the m states and actions among which ``gaps`` chooses are from n others, ``states`` (n, C) and
        ``actions`` (n, F): the distance (m, C + F) of each coordinate and action entry from the nearest value of the
        same entry among the others."""
        off = differences(spec, q[:, None], states[None]), u[:, None] - actions[None]
        nearest: Array = np.abs(np.concatenate(off, 2)).min(1)
        return nearest

    chosen: list[int] = []
    nearest = away(*samples)
    while len(chosen) < min(count, len(settable)):
        chosen.append(int(np.argmax((nearest / ranges).max(1))))
        nearest = np.minimum(nearest, away(q[chosen[-1:]], u[chosen[-1:]]))
    found: NDArray[np.intp] = settable[chosen]
    return found


def differences(spec: EnvironmentSpec, real: Array, predicted: Array) -> Array:
    """Return the coordinates ``real`` minus ``predicted``, (..., C) each. The difference of angles is taken by the
    shorter way around the circle."""
    difference = real - predicted
    for index, coordinate in enumerate(spec.coordinates):
        if coordinate.kind == "angle":
            difference[..., index] = (difference[..., index] + np.pi) % (2 * np.pi) - np.pi
    return difference


def on_one_scale(spec: EnvironmentSpec, q: Array, u: Array, first: int | None = None) -> Array:
    """Return states q (m, C) and actions u (m, F) as points (m, P) whose distances can be compared. An angle becomes
    its cosine and sine.

    Each of the P columns is divided by its standard deviation over all m rows, or over the first ``first`` rows.
    """
    at = columns(spec, q, u)
    spread = at[:first].std(0)
    scaled: Array = at / np.where(spread > 0, spread, 1.0)
    return scaled


def _settable(spec: EnvironmentSpec, q: Array) -> Bools:
    """Return a mask (m,) of those of the states q (m, C) to which the original environment can be set."""
    inside = np.ones(len(q), dtype=bool)
    for index, coordinate in enumerate(spec.coordinates):
        low, high = coordinate.settable
        inside &= (q[:, index] >= low) & (q[:, index] <= high)
    return inside
