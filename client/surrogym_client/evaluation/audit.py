"""The audit of a policy: where on its imagined way to look, and what real steps there say of the model. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import sqrt
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from surrogym_client.policies.evidence import Audit, Promise
from surrogym_shared.spec import EnvironmentSpec

AUDIT_STEPS = 8
ALARM = 0.01  # chance that a right model is blamed for the errors of its outputs
MISPLACED_ENDS = 2  # an audit fails where it predicted the ending of so many steps wrongly
SLACK = 0.1  # of what a policy earns beyond an untrained one: a promise that moves out of its interval by less stands
BIAS = 0.2  # of the same: what the errors of the rewards may add up to in an episode

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Compared:
    """Real steps beside their predictions.

    Attributes:
        names: of the outputs, (O,).
        errors: (n, O) real less predicted, in each output's unit.
        deviations: (n, O) that the model predicted for the function's value.
        expected: (O,) error that the model claims beside: its tolerance, or its leave-one-out error where that is
            larger, which holds the noise; for the reward at least what matters for the return.
        misplaced: steps whose ending was predicted wrongly.
        length: steps of an episode, on average; 0 where that is not known.
        noise: (O,) deviation of the noise of a single step, which ``expected`` holds too; none where it is empty.
    """

    names: Sequence[str]
    errors: Array
    deviations: Array
    expected: Array
    misplaced: int = 0
    length: float = 0.0
    noise: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def claimed(self) -> Array:
        """Deviation (n, O) of each error, as the model claims."""
        scale: Array = np.sqrt(self.deviations**2 + self.expected**2)
        return scale

    def biased(self) -> Bools:
        """Whether the mean error of an output, (O,), is beyond what noise, deviations and tolerance explain.

        Noise hides an error in each step, and not in their mean. Deviations of neighbouring states are those of one
        function, and don't become less in a mean.
        """
        n, count = self.errors.shape
        if not len(self.noise):
            return np.zeros(count, dtype=bool)
        z = NormalDist().inv_cdf(1 - ALARM / (2 * count))
        own = np.sqrt(np.maximum(self.expected**2 - self.noise**2, 0))
        spread = np.sqrt(self.noise**2 / n + (self.deviations**2).mean(0))
        found: Bools = (self.noise > 0) & (np.abs(self.errors.mean(0)) > own + z * spread)
        return found


def judge(compared: Compared, before: Promise, after: Promise, floor: float | None) -> Audit:
    """Hold real steps against the model, and the promise after them against the one before.

    An output is at fault where the sum of squared errors, each over its claimed deviation, is larger than chance
    explains: beyond the 1 % quantile of the chi-squared distribution, shared between the outputs. A noisy output is at
    fault where its mean error is, too. Errors within the tolerance are never a fault.

    Args:
        compared: the real steps.
        before: the promise before the audit.
        after: that of the model that has learned from it.
        floor: the return of an untrained policy; None where nobody measured it.
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
    faults += [
        f"{compared.names[i]}: errors of {compared.errors[:, i].mean():.3g} on average, which is no noise"
        for i in np.flatnonzero(compared.biased() & (sums <= limit)).tolist()
    ]
    if compared.misplaced >= MISPLACED_ENDS:
        faults.append(f"{compared.misplaced} of {n} steps ended, or did not end, against the prediction")
    slack = SLACK * max(earned(before, floor), earned(after, floor))
    if not before.low - slack <= after.median <= before.high + slack:
        faults.append(
            f"the promise moved from {before.median:.4g} to {after.median:.4g} with the audit's steps learned"
        )
    if "reward" in compared.names and compared.length:
        missing = float(compared.errors[:, list(compared.names).index("reward")].mean()) * compared.length
        if abs(missing) > BIAS * earned(before, floor):
            faults.append(f"rewards differ from the prediction by {missing:.4g} in an episode, if all its steps do so")
    return Audit(
        steps=n,
        passed=not faults,
        faults=tuple(faults),
        errors=dict(zip(compared.names, actual.tolist(), strict=True)),
        expected=dict(zip(compared.names, claimed.tolist(), strict=True)),
        before=before,
        after=after,
    )


def disappointed(audit: Audit, floor: float | None) -> bool:
    """Whether the model that has learned from an audit promises clearly less than the one before: the policy was chosen
    in a model that is known better now. A wide promise may stand and disappoint.

    Args:
        audit: what was found.
        floor: the return of an untrained policy; None where nobody measured it.
    """
    lost = audit.before.median - audit.after.median
    return lost > SLACK * max(earned(audit.before, floor), earned(audit.after, floor))


def earned(promise: Promise, floor: float | None) -> float:
    """What a policy earns beyond an untrained one, of return ``floor``; beyond nothing where nobody measured that."""
    return abs(promise.median - (floor or 0.0))


def chi_squared(degrees: int, above: float) -> float:
    """The value that a chi-squared variable exceeds with chance ``above`` (Wilson and Hilferty 1931)."""
    z, c = NormalDist().inv_cdf(1 - above), 2 / (9 * degrees)
    return float(degrees * (1 - c + z * sqrt(c)) ** 3)


def places(spec: EnvironmentSpec, q: Array, u: Array, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Which of the visited states q (m, C) with their actions u (m, F) to ask for, at most ``count``.

    Half of them are drawn at random, so that they stand for the time that the policy spends. The others lie farthest
    from all chosen before, so that they stand for its way; distances are in deviations over what was visited.
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


def differences(spec: EnvironmentSpec, real: Array, predicted: Array) -> Array:
    """Real less predicted coordinates, (n, C); angles by the shorter way."""
    difference = real - predicted
    for index, coordinate in enumerate(spec.coordinates):
        if coordinate.kind == "angle":
            difference[:, index] = (difference[:, index] + np.pi) % (2 * np.pi) - np.pi
    return difference


def on_one_scale(spec: EnvironmentSpec, q: Array, u: Array, first: int | None = None) -> Array:
    """States q (m, C) and actions u (m, F) as points whose distances mean something: angles as cosine and sine, each
    column over its deviation, or over that of the ``first`` rows."""
    columns = [u]
    for index, coordinate in enumerate(spec.coordinates):
        column = q[:, index : index + 1]
        columns += [np.cos(column), np.sin(column)] if coordinate.kind == "angle" else [column]
    at = np.concatenate(columns, 1)
    spread = at[:first].std(0)
    scaled: Array = at / np.where(spread > 0, spread, 1.0)
    return scaled


def _settable(spec: EnvironmentSpec, q: Array) -> Bools:
    """Which states (m,) the original environment can be set to."""
    inside = np.ones(len(q), dtype=bool)
    for index, coordinate in enumerate(spec.coordinates):
        low, high = coordinate.settable
        inside &= (q[:, index] >= low) & (q[:, index] <= high)
    return inside
