"""Calibration: estimation of a simulator's named physical parameters from real steps, with their uncertainty.

Weighted least squares of the errors of single steps, by the trust region reflective method of SciPy (Branch, Coleman
and Li, 1999), and then the posterior beside what no parameter explains (``discrepancy``).

Shapes: n steps, C coordinates, M of them that change, F action entries, P parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import OriginalError, UnknownEnvironment
from surrogym_sampler.original.protocol import Array, is_number
from surrogym_sampler.priors.discrepancy import LEAST_SHARE, SMALLEST, posterior
from surrogym_shared.spec import EnvironmentSpec

# the default range of a parameter goes from its own value divided by this factor to its own value times this factor
AROUND = 2.0


@runtime_checkable
class Adjustable(Protocol):
    """A simulator whose parameters can be read and changed. A change takes effect from the next step on.

    Examples:
        A class that computes something from its parameters defines the two methods itself::

            class Cart:
                def parameters(self):
                    return {"mass": self.mass}

                def set_parameters(self, values):
                    self.mass = values["mass"]
                    self.inverse = 1 / self.mass
    """

    def parameters(self) -> Mapping[str, float]:
        """Return all parameters that can be changed, with their current values."""
        ...

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Change the given parameters; the others keep their values."""
        ...


class Attributes:
    """Offers the numeric attributes of an object that lacks ``parameters`` and ``set_parameters`` as its parameters."""

    def __init__(self, plant: object) -> None:
        self._plant = plant

    def parameters(self) -> dict[str, float]:
        """Return the attributes that are numbers, including those of the class."""
        names = [name for name in dir(self._plant) if not name.startswith("_")]
        return {name: float(value) for name in names if is_number(value := getattr(self._plant, name))}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Set attributes of the object; those of its class stay as they are."""
        for name, value in values.items():
            setattr(self._plant, name, value)


@dataclass(frozen=True)
class Parameter:
    """A parameter to be calibrated, and the range of its values."""

    name: str
    low: float
    high: float

    @classmethod
    def parse(cls, text: str, present: Mapping[str, float]) -> Self:
        """Read ``NAME`` or ``NAME=LOW..HIGH``. The default range is half to twice the simulator's own value.

        Args:
            text: the parameter.
            present: the simulator's own values, by name.

        Raises:
            ValueError: the simulator has no such parameter, or the range is invalid or does not contain the simulator's
                own value.
        """
        name, equals, span = text.partition("=")
        if name not in present:
            known = ", ".join(sorted(present)) or "none"
            raise ValueError(f"expected the name of a parameter of the simulator ({known}), got {name!r}")
        value = present[name]
        if not equals:
            if value == 0:
                raise ValueError(
                    f"{name}: expected a range, because the simulator's own value is 0, got none: give {name}=LOW..HIGH"
                )
            return cls(name, *sorted((value / AROUND, value * AROUND)))
        try:
            low, high = (float(end) for end in span.split(".."))
        except ValueError as error:
            raise ValueError(f"expected NAME=LOW..HIGH, such as mass=0.5..2, got {text!r}") from error
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"range of {name}: expected two finite numbers, the smaller one first, got {span}")
        if not low <= value <= high:
            raise ValueError(
                f"range of {name}: expected one that contains the simulator's own value {value:g}, got {span}: widen it"
            )
        return cls(name, low, high)


def adjustable(simulator: Any) -> Adjustable:
    """Return the parameters of an original environment.

    These are what its methods ``parameters`` and ``set_parameters`` offer, or else its attributes that are numbers.

    Raises:
        UnknownEnvironment: the environment runs in another process, so that its parameters can't be reached.
    """
    for plant in layers(simulator):
        if isinstance(plant, Adjustable):
            return plant
    if getattr(simulator, "step_from", None) is None:
        raise UnknownEnvironment(
            "expected a simulator in this process, got a simulator in another process, whose parameters can't be "
            "changed from here: write a class that runs the simulator in this process (docs/how-to/priors.md)"
        )
    return Attributes(layers(simulator)[-1])


def read_parameters(texts: Sequence[str], plant: Adjustable) -> tuple[Parameter, ...]:
    """Read the parameters to be calibrated, each from a text ``NAME`` or ``NAME=LOW..HIGH``. Raises ``ValueError`` if a
    text is invalid or a parameter is given twice."""
    present = plant.parameters()
    read = tuple(Parameter.parse(text, present) for text in texts)
    names = [parameter.name for parameter in read]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(
            f"expected each parameter once, got {', '.join(sorted(twice))} several times: remove the repetitions"
        )
    return read


def layers(simulator: Any) -> list[Any]:
    """Return the environment and the environments inside it that it wraps, from the outermost to the innermost."""
    layers = [simulator]
    while (inner := getattr(layers[-1], "wrapped", None) or getattr(layers[-1], "simulator", None)) is not None:
        layers.append(inner)
    return layers


def own_name(simulator: Any) -> str:
    """Return the name of an opened simulator: that of the user's class, or the name by which it was opened."""
    every = layers(simulator)
    own = [one for one in every if hasattr(one, "spec")][-1]
    return type(own).__name__ if own is every[-1] else own.spec().environment or type(own).__name__


FEWEST = 2  # smallest number of real steps for a calibration
STARTS = 5  # largest number of starting points of the fit; the first one is the simulator's own values
EXPECTED = 1e-3  # if the error is below this share of the coordinates' changes, no further starting point is tried
EDGE = 0.01  # the first starting point is at least this share of a parameter's range away from the ends of the range
FAR = 1e3  # error that counts for a step which the simulator can't take, in standard deviations of the changes
CONFIDENCE = 0.9  # probability that a parameter is in the interval that a calibration states
WITHIN = 0.29  # standard deviation of a uniform distribution as a share of its range: the prior of a parameter
ROUNDED = 1e-12  # numbers that differ by less than this share are equal but for rounding
FIT: dict[str, Any] = {"bounds": (0.0, 1.0), "x_scale": 0.3, "ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-12}

# Function that takes a step of a simulator: it gets parameters (P,), coordinates (C,) and an action (F,), and returns
# the next coordinates (C,).
Step = Callable[[Array, Array, Array], Array]
# The same for n steps at once: from coordinates (n, C) with actions (n, F) to the next coordinates (n, C). Those of a
# step that failed are not numbers.
Steps = Callable[[Array, Array, Array], Array]


class NotCalibrated(OriginalError):
    """The parameters can't be calibrated; the message says why, and what to do."""


@dataclass(frozen=True)
class RealTransitions:
    """Real steps: coordinates (n, C), actions (n, F) and next coordinates (n, C)."""

    coordinates: Array
    action: Array
    next_coordinates: Array

    def __len__(self) -> int:
        return len(self.coordinates)


@dataclass(frozen=True)
class Calibrated:
    """One calibrated parameter.

    Attributes:
        name: the parameter's name.
        value: the value with the smallest errors of the real steps.
        low: lower end of its 90 % interval.
        high: upper end of its 90 % interval.
        determined: False if the steps say little more about it than its range does.
    """

    name: str
    value: float
    low: float
    high: float
    determined: bool


@dataclass(frozen=True)
class Calibration:
    """The result of a calibration. Errors are root mean squares over steps and coordinates, as shares of the standard
    deviation of each coordinate's changes."""

    parameters: tuple[Calibrated, ...]
    steps: int  # number of real steps that were used
    failed: (
        int  # number of further real steps that were not used, because the simulator with its own values fails there
    )
    error_before: float  # error of the simulator with its own parameter values
    error: float  # error of the simulator with the calibrated parameter values

    @property
    def values(self) -> dict[str, float]:
        """The calibrated values by name."""
        return {parameter.name: parameter.value for parameter in self.parameters}


def calibrate(
    spec: EnvironmentSpec,
    real: RealTransitions,
    parameters: Sequence[Parameter],
    own: Array,
    step: Step,
    many: Steps | None = None,
) -> Calibration:
    """Calibrate the parameters of a simulator on real steps.

    Args:
        spec: the specification, which says which coordinates are angles.
        real: the real steps, at least two.
        parameters: the P parameters and their ranges. If there are none, only the error is computed.
        own: the simulator's own values (P,) of the parameters.
        step: takes one step of the simulator; if it raises, the step counts as very wrong.
        many: takes several steps at once, which is faster; None if the simulator can't.

    Raises:
        NotCalibrated: the steps measure no more numbers than there are parameters, or the simulator fails in more than
            half of the steps with its own values.
    """
    if len(real) < FEWEST:
        raise NotCalibrated(f"expected at least {FEWEST} real steps for a calibration, got {len(real)}: take more")
    errors = _Errors(spec, real, step, many)
    before = errors(own)
    failed = (np.abs(before) >= FAR).all(1)
    if failed.mean() > 0.5:
        raise NotCalibrated(
            f"expected a simulator that can repeat the real steps, got a simulator that fails in most of {len(real)}"
            f"{errors.failure}: check its coordinates, units and actions, or give it a smaller time step"
        )
    if failed.any():
        real = RealTransitions(*(column[~failed] for column in vars(real).values()))
        errors = _Errors(spec, real, step, many)
        before = errors(own)
    if errors.measured <= len(parameters):
        raise NotCalibrated(
            f"expected at least {len(parameters) // errors.moving + 1} real steps to calibrate {len(parameters)} "
            f"parameters, got {len(real)}: calibrate fewer parameters, or register the plant with a larger --initial"
        )
    counts = (len(real), int(failed.sum()))
    if not parameters:
        return Calibration((), *counts, _rms(before), _rms(before))
    scaling = _Scaling.of(parameters)
    x = _best(errors, scaling, own)
    found = _with_intervals(parameters, scaling, errors, own, x)
    return Calibration(found, *counts, _rms(before), _rms(errors(scaling.values(x))))


class _Errors:
    """The errors (n, M) of a simulator's steps for given parameters, in standard deviations of the M coordinates that
    change."""

    def __init__(self, spec: EnvironmentSpec, real: RealTransitions, step: Step, many: Steps | None = None) -> None:
        self._real, self._step, self._many = real, step, many or self._one_by_one
        self._angles = np.array([coordinate.kind == "angle" for coordinate in spec.coordinates])
        change = self._difference(real.next_coordinates, real.coordinates)
        scale = np.sqrt((change**2).mean(0))
        self._moves = scale > 0
        self._scale = scale[self._moves]
        self.failure = ""
        self.moving = max(1, int(self._moves.sum()))

    @property
    def inputs(self) -> Array:
        """What the steps depend on (n, I), each in its standard deviations: coordinates, angles as cosine and sine, and
        actions, those that vary."""
        q = self._real.coordinates
        turned = np.where(self._angles, np.sin(q), 0.0)[:, self._angles]
        columns = np.concatenate([np.where(self._angles, np.cos(q), q), turned, self._real.action], 1)
        deviation = columns.std(0)
        vary = deviation > ROUNDED * np.abs(columns).max(0)
        return np.asarray(columns[:, vary] / deviation[vary])

    @property
    def measured(self) -> int:
        """Number of measured numbers: real steps times coordinates that change."""
        return len(self._real) * int(self._moves.sum())

    def __call__(self, values: Array) -> Array:
        try:
            rows = self._many(values, self._real.coordinates, self._real.action)
        except Exception as error:
            rows = self._failed(error, self._real.coordinates.shape)
        if not self.failure and not np.isfinite(rows).all():
            self.failure = ", with numbers that are infinite or NaN, as a solver that diverges gives"
        errors = self._difference(rows, self._real.next_coordinates)[:, self._moves] / self._scale
        return np.where(np.isfinite(errors), np.clip(errors, -FAR, FAR), FAR)

    def _one_by_one(self, values: Array, coordinates: Array, actions: Array) -> Array:
        return np.array([self._one(values, *row) for row in zip(coordinates, actions, strict=True)])

    def _one(self, values: Array, coordinates: Array, action: Array) -> Array:
        try:
            return np.asarray(self._step(values, coordinates, action), dtype=np.float64)
        except Exception as error:
            return self._failed(error, coordinates.shape)

    def _failed(self, error: Exception, shape: tuple[int, ...]) -> Array:
        """Results of steps that raised an error, as a user's code may, so that they count as very wrong."""
        self.failure = f" ({type(error).__name__}: {str(error)[:80]})"
        return np.full(shape, np.nan)

    def _difference(self, one: Array, other: Array) -> Array:
        difference = one - other
        turned = (difference + np.pi) % (2 * np.pi) - np.pi
        return np.where(self._angles, turned, difference)


@dataclass(frozen=True)
class _Scaling:
    """Scaling of P parameters to numbers x in [0, 1] (P,); parameters that are positive in their whole range are scaled
    logarithmically."""

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
        """Return the values (P,) of the P parameters for their scaled numbers x (P,)."""
        at = self.low + x * (self.high - self.low)
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, at, 0.0)), at)

    def numbers(self, values: Array) -> Array:
        """Return the scaled numbers x (P,) for the values (P,) of the P parameters."""
        at = np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)
        return np.asarray((at - self.low) / (self.high - self.low))


def _best(errors: _Errors, scaling: _Scaling, own: Array) -> Array:
    """Return the P scaled parameters x (P,) with the smallest weighted errors, found from several starting points.

    The distance of each parameter from the simulator's own value, in standard deviations of its range, counts as one
    more error. So a parameter that the steps don't determine keeps that value.
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
    """Return the weight of each of the M coordinates that change (M,). A coordinate that is noisy, or that the
    simulator predicts badly, gets a smaller weight."""
    sizes = np.sqrt((errors**2).mean(0))
    return np.asarray(1.0 / np.maximum(sizes, max(SMALLEST, LEAST_SHARE * sizes.max())))


def _with_intervals(
    parameters: Sequence[Parameter], scaling: _Scaling, errors: _Errors, own: Array, x: Array
) -> tuple[Calibrated, ...]:
    """Return the parameters with their scaled values ``x`` (P,), and intervals of the posterior, which contain them.

    The posterior's own most probable values are nearer to the true ones, but leave larger errors to be learned.
    """
    present = np.clip(scaling.numbers(own), EDGE, 1 - EDGE)
    found = posterior(lambda at: errors(scaling.values(at)), errors.inputs, present, WITHIN, x)
    low, high = found.interval(CONFIDENCE)
    ends = (scaling.values(at) for at in (x, np.clip(low, 0, x), np.clip(high, x, 1)))
    columns = zip(parameters, *(end.tolist() for end in ends), (found.deviations < WITHIN / 2).tolist(), strict=True)
    return tuple(Calibrated(parameter.name, *column) for parameter, *column in columns)


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))
