"""Comparison of arriving real steps with one model of a surrogate, and descriptions of a drift.

Shapes: n steps, O outputs, C coordinates, F action entries.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surrogym_client.transport import routes
from surrogym_client.transport.api import Api
from surrogym_shared.logs.rows import impossible
from surrogym_shared.spec import BoxAction, EnvironmentSpec, limits
from surrogym_shared.wire import PolicyView, SurrogateView
from surrogym_shared.wire.policies import AddDrift
from surrogym_trainer.evaluation.audit import Compared
from surrogym_trainer.evaluation.comparing import StepOfEpisode, compared, steady
from surrogym_trainer.watching.detector import Detector
from surrogym_trainer.watching.units import OtherUnits, converted, other_units

BATCH = 500  # largest number of real steps that one request to the server contains
FIRST = 20  # whether steps come in other units is decided by the first steps, at least this number
KEPT = 2_000  # a drift is described from at most this number of latest steps
QUARTERS = ("lowest", "second", "third", "highest")
# errors count as concentrated in a quarter of an input's range if the quarter adds more than this to the relative
# entropy (in nats) of the squared errors' distribution over the quarters to that of the steps
TELLING = 0.1

Array = NDArray[np.float64]


class Region(NamedTuple):
    """The quarter of an input's range in which an error is largest. An input is a coordinate or an action entry."""

    name: str
    low: float
    high: float
    quarter: str
    share: float  # sum of the squared errors in this quarter of the input's range, as a share of the sum over the range

    def words(self) -> str:
        return (
            f"{self.share:.0%} of it where {self.name} is between {self.low:.4g} and {self.high:.4g}, the "
            f"{self.quarter} quarter of its range"
        )


@dataclass(frozen=True)
class Alarm:
    """A drift that was detected.

    Attributes:
        output: name of the output.
        error: mean of real minus predicted values since the change, in the output's unit; their root mean square if the
            errors have grown in both directions.
        both: whether the errors have grown in both directions.
        expected: root mean square error that the model predicts at these steps.
        latest: number of steps since the change.
        compared: number of steps that were compared.
        line: line number, in the log, of the step that gave the alarm.
        region: the part of an input's range with most of the error; None if no input has a range.
    """

    output: str
    error: float
    both: bool
    expected: float
    latest: int
    compared: int
    line: int
    region: Region | None

    @property
    def from_the_start(self) -> bool:
        """Whether the drift is in most of the compared steps, so that the plant may have differed from the model at the
        first step."""
        return self.latest > self.compared / 2

    def words(self) -> str:
        """Return a sentence about which output is wrong, by how much, and where."""
        how = "in both directions, root mean square" if self.both else "on average"
        size = f"{self.error:.3g}" if self.both else f"{self.error:+.3g}"
        last = "the last real step" if self.latest == 1 else f"the last {self.latest} real steps"
        where = "" if self.region is None else f"; {self.region.words()}"
        return (
            f"{self.output} is {size} off the prediction ({how}) in {last}, where the model expects errors of "
            f"{self.expected:.3g}{where}"
        )


class Watcher:
    """Compares real steps with the model that a surrogate serves now, and detects drift. The model does not learn from
    the steps."""

    def __init__(self, api: Api, view: SurrogateView, false_alarm_steps: float) -> None:
        """Start watching a surrogate.

        Args:
            api: the connection to the server.
            view: the surrogate, which has a model.
            false_alarm_steps: the average number of real steps until a false alarm is at least this.
        """
        self._api, self._view = api, view
        self._false_alarm_steps = false_alarm_steps
        self._detector: Detector | None = None
        # for each of the latest steps: errors (O,) and predicted standard deviations (O,) of O outputs, and inputs
        # (C + F,)
        self._recent: deque[tuple[Array, Array, Array]] = deque(maxlen=KEPT)
        self._first: list[StepOfEpisode] = []  # the first steps, at most ``FIRST``
        self._found: Alarm | None = None
        self._inputs = _inputs_of(view.spec)
        self._visits = np.zeros((len(self._inputs), len(QUARTERS)))
        # number of steps that were not compared, because a constant coordinate changed or a lag was not known
        self.left_out = 0

    @property
    def compared(self) -> int:
        """Number of real steps that were compared."""
        return 0 if self._detector is None else self._detector.steps

    @property
    def evidence(self) -> float:
        """The evidence so far that the real steps have drifted from the model. There is an alarm once it reaches
        ``false_alarm_steps``."""
        return 0.0 if self._detector is None else self._detector.evidence

    def take(self, steps: Sequence[StepOfEpisode]) -> Alarm | None:
        """Compare at most ``BATCH`` steps, and return the alarm if there is one, now or before. The ``number`` of each
        step is its line in the log.

        Raises:
            SurrogymClientError: the server can't be reached, or refuses a request.
        """
        spec = self._view.spec
        usable = steady(spec, [step for step in steps if spec.known(step.coordinates)])
        self.left_out += len(steps) - len(usable)
        self._first += usable[: FIRST - len(self._first)]
        if self._found is not None or not usable:
            return self._found
        beside = compared(self._api, spec, self._view, usable)
        if self._detector is None:
            self._detector = Detector(beside.claimed_alone, self._tolerances(beside.names), self._false_alarm_steps)
        errors = _without_terminal_rewards(beside, usable)
        inputs = np.concatenate([beside.states, beside.actions], 1)
        for i, step in enumerate(usable):
            self._recent.append((errors[i], beside.deviations[i], inputs[i]))
            self._visits[np.arange(len(self._inputs)), self._quarters(inputs[i : i + 1])[0]] += 1
            if (drift := self._detector.step(errors[i], beside.deviations[i])) is not None:
                self._found = self._alarm(beside, drift.output, drift.shifted, drift.steps, step.number)
                return self._found
        return None

    def other_units(self) -> tuple[OtherUnits | None, bool]:
        """Return the units in which the first steps seem to come, in place of a drift that is there from the start, and
        whether that is certain. It is uncertain while fewer than ``FIRST`` steps were taken."""
        if self._found is None or not self._found.from_the_start:
            return None, True
        spec, steps = self._view.spec, self._first
        beside = compared(self._api, spec, self._view, steps)
        paid = np.array([one.reward for one in steps])
        if "reward" in beside.names:
            paid = paid - beside.errors[:, list(beside.names).index("reward")]
        return other_units(spec, steps, paid, self._misfit), len(steps) == FIRST

    def _misfit(self, scale: Array, shift: Array) -> float:
        """Return the negative log-likelihood of the first steps after their conversion by ``scale`` (C + F + 1,) and
        ``shift`` (C + F + 1,), without a constant; infinity if they give an alarm, or if a value is impossible."""
        spec, steps = self._view.spec, converted(self._first, scale, shift)
        if any(impossible(spec, q) for one in steps for q in (one.coordinates, one.next_coordinates)):
            return inf
        bounds = spec.action.ranges
        if not all(low <= u <= high for one in steps for u, (low, high) in zip(one.action, bounds, strict=True)):
            return inf
        other = Watcher(self._api, self._view, self._false_alarm_steps)
        if other.take(steps) is not None or other.compared < len(steps):
            return inf
        beside = compared(self._api, spec, self._view, steps)
        return float(((beside.errors / beside.claimed) ** 2 / 2 + np.log(beside.claimed)).sum())

    def withdraw(self, version: int, alarm: Alarm) -> PolicyView:
        """Report a drift for a version of the policy, so that its promise is no longer trusted. Returns the policy."""
        content = f"{self._view.model_version} {alarm!r}".encode()
        body = AddDrift(
            output=alarm.output,
            error=alarm.error,
            words=alarm.words(),
            steps=alarm.compared,
            idempotency_key=hashlib.sha256(content).hexdigest(),
        )
        route = f"{routes.policy(self._view.name, version)}/drifts"
        return self._api.connection.post(PolicyView, route, body)

    def _tolerances(self, names: Sequence[str]) -> Array:
        assert self._view.fidelity is not None
        known = {output.name: output.tolerance for output in self._view.fidelity.outputs}
        return np.array([known[name] for name in names])

    def _alarm(self, beside: Compared, output: int, shifted: bool, latest: int, line: int) -> Alarm:
        recent = [one for one in list(self._recent)[-latest:] if np.isfinite(one[0][output])]
        errors = np.array([error[output] for error, _, _ in recent])
        deviations = np.array([deviation[output] for _, deviation, _ in recent])
        return Alarm(
            output=beside.names[output],
            error=float(errors.mean()) if shifted else sqrt(float((errors**2).mean())),
            both=not shifted,
            expected=sqrt(float((deviations**2).mean()) + float(beside.claimed_alone[output]) ** 2),
            latest=len(errors),
            compared=self.compared,
            line=line,
            region=self._region(errors, np.array([inputs for _, _, inputs in recent])),
        )

    def _region(self, errors: Array, inputs: Array) -> Region | None:
        """Return the quarter of an input's range that most likely explains the errors (n,). It is the quarter where the
        squared errors are concentrated most, compared with the steps of the whole stream. If no quarter stands out, it
        is the one with most of the squared errors."""
        if not self._inputs:
            return None
        quarters, weight = self._quarters(inputs), errors**2 / max(float((errors**2).sum()), 1e-300)
        shares = np.stack([weight @ (quarters == number) for number in range(len(QUARTERS))], 1)
        usual = self._visits / self._visits.sum(1, keepdims=True)
        telling = np.where(shares > 0, shares * np.log(shares.clip(1e-12) / usual.clip(1e-12)), 0.0)
        chosen = telling if telling.max() > TELLING else shares
        row, quarter = np.unravel_index(int(chosen.argmax()), shares.shape)
        name, low, high = self._inputs[int(row)]
        ends = np.linspace(low, high, len(QUARTERS) + 1)
        return Region(
            name, float(ends[quarter]), float(ends[quarter + 1]), QUARTERS[quarter], float(shares[row, quarter])
        )

    def _quarters(self, inputs: Array) -> NDArray[np.intp]:
        """Return the quarter (n, K), 0 to 3, of its range in which each of K inputs with a range lies, for n rows of
        coordinates and action entries (n, C + F). A value outside the range counts as in its first or last quarter."""
        names = [*self._view.spec.coordinate_names, *_actions(self._view.spec)]
        columns = inputs[:, [names.index(name) for name, _, _ in self._inputs]]
        low, high = (np.array([one[end] for one in self._inputs]) for end in (1, 2))
        quarters = np.floor((columns - low) / (high - low) * len(QUARTERS))
        whole: NDArray[np.intp] = quarters.clip(0, len(QUARTERS) - 1).astype(np.intp)
        return whole


def _inputs_of(spec: EnvironmentSpec) -> list[tuple[str, float, float]]:
    """Return name, low and high of each coordinate and action entry that has a range."""
    ranged = [(one.name, *limits(one.sampling)) for one in spec.coordinates]
    if isinstance(spec.action, BoxAction):
        ranged += zip(_actions(spec), spec.action.low, spec.action.high, strict=True)
    return [(name, low, high) for name, low, high in ranged if high > low]


def _actions(spec: EnvironmentSpec) -> list[str]:
    return [f"action {i}" for i in range(spec.action.size)]


def _without_terminal_rewards(beside: Compared, steps: Sequence[StepOfEpisode]) -> Array:
    """Return the errors (n, O), with NaN for the reward of a step that ended its episode, because it may contain a
    terminal reward."""
    errors = beside.errors.copy()
    if "reward" in beside.names:
        errors[[step.terminated for step in steps], list(beside.names).index("reward")] = np.nan
    return errors
