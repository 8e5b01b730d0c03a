"""Detection of drift in an endless stream of a model's prediction errors, with a known rate of false alarms. All
functions are pure.

An audit tests once whether its few errors share a part (``evaluation.systematic``). A stream has no end, and the plant
may change at any step, so the test has to begin again at each step and to forget what was long ago. That is an
e-detector: the sum, over all steps at which a change may have begun, of the evidence for a change since then. The sum
is the recursion M <- (M + 1) L, where L is the evidence of one step, whose expectation is at most 1 without a change.
An alarm at M >= N has an average run length of at least N steps without a change (J. Shin, A. Ramdas, A. Rinaldo 2024,
"E-detectors: a nonparametric framework for sequential change detection", New England Journal of Statistics in Data
Science 2(2), theorem 2.4; the recursion is that of Shiryaev and Roberts). M is the mean over bets.

Each bet is on the standardised error z of one output, L = exp(l z - l^2 / 2) for a shift of size l in one direction, or
L = sqrt(1 - g) exp(g z^2 / 2) for a spread. Both have an expectation of at most 1 if z has mean 0 and is no wider than
a standard normal variable.

Without a change the error e of a step has these parts, of which z = (e - m) / sqrt(s^2 + (SHARE d)^2) is made:

- a mean m that the stream has shown, within ``BIAS`` standard deviations d of the model. A policy spends its time at
  few states, where the error of a right model is the same again and again. Before the first step it is N(0, d^2);
- the uncertainty d of the model at this step;
- noise of standard deviation s. The stream shows it, beginning with the model's error on left-out samples.

A single error counts for at most ``MOST`` deviations, so that one spike is no alarm. Noise with heavier tails than a
normal variable can give a bet an average L above 1. So each L of this bet is divided by its average L in the stream so
far, limited to the range from 1 to ``MOST_PAID``. Errors that resemble those of the step before, beyond their mean,
raise the rate of false alarms.

Shapes: O outputs, B bets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# the detector tests for changes of the mean error of these sizes, in standard deviations of an error
SHIFTS = (0.5, 1.0, 2.0)
# the detector tests for an increase of the errors' variance by the factor 1 / (1 - g), for each g
SPREADS = (0.25, 0.5)
BIAS = 3.0  # a mean error of up to this number of the model's standard deviations is the model's own error, no drift
# the variance of an error is expected to be noise ** 2 + (SHARE * d) ** 2, where d is the model's standard deviation
SHARE = 1.5
# an error of more than this number of standard deviations counts as one of this size, so that one spike gives no alarm
MOST = 4.0
# before the noise is estimated from an error, the error is limited to this number of the noise's standard deviations
OUTLYING = 3.0
# the noise is estimated from the steps and from the model's error on left-out samples, which counts as this number of
# steps
NOISE_STEPS = 20.0
# the average factor by which a step multiplies the evidence for a change is taken to be 1 at first, with the weight of
# this number of steps
PAID_STEPS = 100.0
# if steps multiply the evidence for a change by more than 1 on average, an average of up to this factor is attributed
# to heavy tails of the noise
MOST_PAID = 1.5
NEGLIGIBLE = 0.1  # smallest standard deviation that noise and model are taken to have, as a share of the tolerance

Array = NDArray[np.float64]


class Drift(NamedTuple):
    """A change in the errors that was detected.

    Attributes:
        output: index of the output with the largest evidence.
        shifted: whether the errors of this output have a new mean; otherwise they are only larger than before.
        steps: number of latest steps that show the change.
    """

    output: int
    shifted: bool
    steps: int


class Detector:
    """A detector that tests the errors of a model step by step for a change."""

    def __init__(self, claimed: Array, tolerance: Array, false_alarm_steps: float) -> None:
        """Start a detector.

        Args:
            claimed: error (O,) of the model on left-out samples, which includes the noise.
            tolerance: error (O,) that is too small to matter.
            false_alarm_steps: the average number of steps until a false alarm is at least this.
        """
        self._least = NEGLIGIBLE * tolerance
        self._alarm = false_alarm_steps
        self._sum, self._known_steps = np.zeros(len(claimed)), np.zeros(len(claimed))
        self._squares = NOISE_STEPS * np.maximum(claimed, self._least) ** 2
        count = 2 * len(SHIFTS) + len(SPREADS)
        half = [1 / (4 * len(SHIFTS))] * (2 * len(SHIFTS)) + [1 / (2 * len(SPREADS))] * len(SPREADS)
        # (B,) weights of B tested changes (bets): half of the weight is on changes of the mean, half on larger
        # variances
        self._weights = np.array(half) / len(claimed)
        # (O, B) for O outputs: evidence for each tested change at any step so far
        self._evidence = np.zeros((len(claimed), count))
        # (O, B) sum, over the steps, of the factor by which a step multiplies the evidence; divided by the steps, it is
        # the average
        self._paid = np.full((len(claimed), count), PAID_STEPS)
        # (O, B) logarithm of the evidence of the steps since the one at which each change most likely began
        self._run = np.zeros((len(claimed), count))
        # (O, B) number of the step at which each change most likely began
        self._begun = np.zeros((len(claimed), count), dtype=np.int64)
        self.steps = 0

    @property
    def evidence(self) -> float:
        """The evidence that the errors have changed at any of the steps so far. ``step`` returns a drift once it
        reaches ``false_alarm_steps``."""
        return float((self._evidence * self._weights).sum())

    def step(self, error: Array, deviation: Array) -> Drift | None:
        """Add the errors of one step, and return the change if there is enough evidence, else None.

        Args:
            error: real minus predicted values (O,); NaN for an output that this step does not test.
            deviation: standard deviations (O,) of the model at this step, without noise.
        """
        known = np.isfinite(error)
        uncertain = np.hypot(deviation, self._least)
        noise = np.sqrt(self._squares / (NOISE_STEPS + self._known_steps))
        # posterior mean of the errors without a change; their prior is N(0, d^2), where d is the model's standard
        # deviation
        mean = self._sum / (self._known_steps + (noise / uncertain) ** 2)
        mean = mean.clip(-BIAS * uncertain, BIAS * uncertain)
        beyond = np.where(known, error - mean, 0.0)
        paid = (self._paid / (PAID_STEPS + self._known_steps[:, None])).clip(1.0, MOST_PAID)
        won = _log_bets(beyond / np.hypot(noise, SHARE * uncertain))
        self._paid += np.where(known[:, None], np.exp(won), 0.0)
        log_bets = np.where(known[:, None], won - np.log(paid), 0.0)
        self._evidence = (1 + self._evidence) * np.exp(log_bets)
        self._begun[self._run <= 0] = self.steps
        self._run = np.maximum(self._run, 0.0) + log_bets
        self.steps += 1
        self._learn(known, mean, beyond, noise)
        return self._found() if self.evidence >= self._alarm else None

    def _learn(self, known: NDArray[np.bool_], mean: Array, beyond: Array, noise: Array) -> None:
        """Update the estimated mean and noise of the errors by one step. Large errors are limited first, so that a
        change or an outlier does not count as noise.

        Args:
            known: mask (O,) of the outputs that the step tests.
            mean: estimated mean (O,) of the errors before the step.
            beyond: errors (O,) of the step, minus this mean.
            noise: estimated standard deviation (O,) of the noise before the step.
        """
        limited = beyond.clip(-OUTLYING * noise, OUTLYING * noise)
        self._sum += np.where(known, mean + limited, 0.0)
        self._squares += np.where(known, limited**2, 0.0)
        self._known_steps += known
        self._squares = np.maximum(self._squares, (NOISE_STEPS + self._known_steps) * self._least**2)

    def _found(self) -> Drift:
        output, bet = np.unravel_index(int((self._evidence * self._weights).argmax()), self._evidence.shape)
        return Drift(int(output), bool(bet < 2 * len(SHIFTS)), int(self.steps - self._begun[output, bet]))


def _log_bets(z: Array) -> Array:
    """Return the logarithms (O, B) of the evidence that standardised errors z (O,) of one step give for each of B kinds
    of change, such as a shift of a certain size (a bet)."""
    z = z.clip(-MOST, MOST)[:, None]
    shifts, spreads = np.array([sign * size for sign in (1, -1) for size in SHIFTS]), np.array(SPREADS)
    return np.concatenate([shifts * z - shifts**2 / 2, 0.5 * np.log(1 - spreads) + spreads * z**2 / 2], 1)
