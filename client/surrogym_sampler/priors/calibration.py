"""Calibration: the values of a simulator's parameters with which it repeats real steps, and how uncertain they are.

Weighted least squares of the errors of single steps, by the trust region reflective method of SciPy (Branch, Coleman
and Li, 1999). The uncertainty is Laplace's approximation: the inverse of the Gauss-Newton matrix at the optimum.

Shapes: n steps, C coordinates, F action entries, P parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import OriginalError
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.priors.parameters import Parameter
from surrogym_shared.spec import EnvironmentSpec

FEWEST = 2  # real steps
STARTS = 5  # starting points at most; the first one is the simulator's own values
EXPECTED = 1e-3  # of the changes: with smaller errors no further starting point is tried
EDGE = 0.01  # of a range: least distance of a starting point from its ends
SMALLEST = 1e-9  # of the changes: an error below this share counts as rounding
FAR = 1e3  # error, in standard deviations of the changes, of a step that the simulator can't take
CONFIDENCE = 0.9  # of the interval of each parameter
NUDGE = 1e-5  # of a parameter's range, for its derivatives
WITHIN = 0.29  # of a range: the standard deviation of a parameter of which only its range is known
FINEST = 1e-7  # of a range: smallest standard deviation of a parameter, as the fit itself is no finer
ROUNDING = 1e-14  # of the largest eigenvalue: a direction below it says nothing
FIT: dict[str, Any] = {"bounds": (0.0, 1.0), "x_scale": 0.3, "ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-12}
LEAST_SHARE = 1e-3  # of the largest error: a coordinate with a smaller one counts no more

Step = Callable[[Array, Array, Array], Array]  # parameters (P,), coordinates (C,), action (F,): next coordinates (C,)


class NotCalibrated(OriginalError):
    """The parameters can't be calibrated. The message says why, and what to do."""


@dataclass(frozen=True)
class RealTransitions:
    """Real steps from coordinates (n, C) under actions (n, F) to next coordinates (n, C)."""

    coordinates: Array
    action: Array
    next_coordinates: Array

    def __len__(self) -> int:
        return len(self.coordinates)


@dataclass(frozen=True)
class Calibrated:
    """One parameter: its value, and the ends of its 90 % interval. ``determined`` is False if the steps say little more
    of it than its range does."""

    name: str
    value: float
    low: float
    high: float
    determined: bool


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration. Errors are root mean squares over steps and coordinates, as shares of the standard
    deviation of each coordinate's changes."""

    parameters: tuple[Calibrated, ...]
    steps: int
    error_before: float  # with the simulator's own values
    error: float  # with the calibrated values

    @property
    def values(self) -> dict[str, float]:
        """The calibrated values by name."""
        return {parameter.name: parameter.value for parameter in self.parameters}


def calibrate(
    spec: EnvironmentSpec, real: RealTransitions, parameters: Sequence[Parameter], own: Array, step: Step
) -> Calibration:
    """Calibrate the parameters of a simulator on real steps.

    Args:
        spec: coordinates of both, of which some are angles.
        real: the real steps, at least two.
        parameters: the parameters and their ranges, (P,). Without any the error alone is computed.
        own: the simulator's own values, (P,).
        step: one step of the simulator; an error of it counts as a step far off.

    Raises:
        NotCalibrated: fewer numbers were measured than there are parameters; or the simulator can't take half of the
            steps with its own values.
    """
    if len(real) < FEWEST:
        raise NotCalibrated(f"expected at least {FEWEST} real steps, got {len(real)}")
    errors = _Errors(spec, real, step)
    if errors.measured <= len(parameters):
        raise NotCalibrated(
            f"expected at least {len(parameters) // errors.moving + 1} real steps to calibrate {len(parameters)} "
            f"parameters, got {len(real)}: calibrate fewer, or register the plant with --initial and more steps"
        )
    before = errors(own)
    if (np.abs(before) >= FAR).all(1).mean() > 0.5:
        raise NotCalibrated(
            f"expected a simulator that can take the real steps, got one that fails in most of {len(real)}"
            f"{errors.failure}: check its coordinates, units and actions"
        )
    if not parameters:
        return Calibration((), len(real), _rms(before), _rms(before))
    scaling = _Scaling.of(parameters)
    x = _best(errors, scaling, own)
    return Calibration(
        _with_intervals(parameters, scaling, errors, x), len(real), _rms(before), _rms(errors(scaling.values(x)))
    )


class _Errors:
    """Errors (n, M) of a simulator's steps, in standard deviations of the M coordinates that change."""

    def __init__(self, spec: EnvironmentSpec, real: RealTransitions, step: Step) -> None:
        self._real, self._step = real, step
        self._angles = np.array([coordinate.kind == "angle" for coordinate in spec.coordinates])
        change = self._difference(real.next_coordinates, real.coordinates)
        scale = np.sqrt((change**2).mean(0))
        self._moves = scale > 0
        self._scale = scale[self._moves]
        self.failure = ""
        self.moving = max(1, int(self._moves.sum()))

    @property
    def measured(self) -> int:
        """Number of measured changes."""
        return len(self._real) * int(self._moves.sum())

    def __call__(self, values: Array) -> Array:
        rows = [self._one(values, *row) for row in zip(self._real.coordinates, self._real.action, strict=True)]
        errors = self._difference(np.array(rows), self._real.next_coordinates)[:, self._moves] / self._scale
        return np.where(np.isfinite(errors), np.clip(errors, -FAR, FAR), FAR)

    def _one(self, values: Array, coordinates: Array, action: Array) -> Array:
        try:
            return np.asarray(self._step(values, coordinates, action), dtype=np.float64)
        except Exception as error:  # any code of a user: a step that can't be taken is one far off
            self.failure = f" ({type(error).__name__}: {str(error)[:80]})"
            return np.full(len(coordinates), np.nan)

    def _difference(self, one: Array, other: Array) -> Array:
        difference = one - other
        turned = (difference + np.pi) % (2 * np.pi) - np.pi
        return np.where(self._angles, turned, difference)


@dataclass(frozen=True)
class _Scaling:
    """Parameters as numbers x in [0, 1] (P,): the logarithm of those that are positive in their whole range."""

    low: Array
    high: Array
    logarithmic: NDArray[np.bool_]

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> _Scaling:
        low, high = (np.array([getattr(one, end) for one in parameters]) for end in ("low", "high"))
        logarithmic = low > 0
        take = np.where(logarithmic, low, 1.0), np.where(logarithmic, high, 1.0)
        return cls(
            np.where(logarithmic, np.log(take[0]), low), np.where(logarithmic, np.log(take[1]), high), logarithmic
        )

    def values(self, x: Array) -> Array:
        """Values of x (P,)."""
        at = self.low + x * (self.high - self.low)
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, at, 0.0)), at)

    def numbers(self, values: Array) -> Array:
        """The x of values (P,)."""
        at = np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)
        return np.asarray((at - self.low) / (self.high - self.low))


def _best(errors: _Errors, scaling: _Scaling, own: Array) -> Array:
    """Numbers x (P,) of the parameters with the smallest weighted errors, from several starting points.

    A parameter that the steps say nothing of keeps the simulator's own value, because the distance from it, in standard
    deviations of its range, counts as one more error.
    """
    from scipy.optimize import least_squares
    from scipy.stats import qmc

    present = np.clip(scaling.numbers(own), EDGE, 1 - EDGE)

    def fit(start: Array, weights: Array | float, unit: float) -> Array:
        def all_errors(x: Array) -> Array:
            return np.concatenate([(errors(scaling.values(x)) * weights).ravel(), unit * (x - present) / WITHIN])

        found: Array = least_squares(all_errors, start, **FIT).x
        return found

    best, least = present, np.inf
    for start in (present, *qmc.LatinHypercube(len(own), seed=0).random(STARTS - 1)):
        x = fit(start, 1.0, EXPECTED)
        if (error := _rms(errors(scaling.values(x)))) < least:
            best, least = x, error
        if least < EXPECTED:
            break
    return fit(best, _weights(errors(scaling.values(best))), 1.0)


def _weights(errors: Array) -> Array:
    """Weight (M,) of each coordinate: a coordinate with noise, or that the simulator repeats badly, counts less."""
    sizes = np.sqrt((errors**2).mean(0))
    return np.asarray(1.0 / np.maximum(sizes, max(SMALLEST, LEAST_SHARE * sizes.max())))


def _with_intervals(
    parameters: Sequence[Parameter], scaling: _Scaling, errors: _Errors, x: Array
) -> tuple[Calibrated, ...]:
    from scipy.stats import t

    off = errors(scaling.values(x))
    weights, rows = _weights(off), len(off)
    jacobian = np.stack([((_moved(errors, scaling, x, i) - off) * weights / NUDGE).ravel() for i in range(len(x))], 1)
    left = max(1.0, rows - len(parameters) / errors.moving)  # the weights are of the same steps
    variance = float(((off * weights) ** 2).sum()) / errors.moving / left
    size, axes = np.linalg.eigh(jacobian.T @ jacobian)
    size = np.where(size > ROUNDING * size.max(), size, 0.0) / max(variance, np.finfo(float).tiny)
    spread = np.maximum(np.sqrt((axes**2 / (size + 1 / WITHIN**2)).sum(1)), FINEST)
    reach = spread * t.ppf(0.5 + CONFIDENCE / 2, left)
    ends = (scaling.values(at) for at in (x, np.clip(x - reach, 0, 1), np.clip(x + reach, 0, 1)))
    columns = zip(parameters, *(end.tolist() for end in ends), (spread < WITHIN / 2).tolist(), strict=True)
    return tuple(Calibrated(parameter.name, *column) for parameter, *column in columns)


def _moved(errors: _Errors, scaling: _Scaling, x: Array, index: int) -> Array:
    """Errors with one parameter moved a little."""
    at = x.copy()
    at[index] += NUDGE
    return errors(scaling.values(at))


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))
