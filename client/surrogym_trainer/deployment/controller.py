"""The computation of a controller, from raw measurements to actions, as data. The files for every target are generated
from it.

Shapes: C coordinates, R measurements, D observation entries, A outputs of the network, F action entries. A place is the
index of a coordinate among all C.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surrogym_client.errors import SurrogymClientError
from surrogym_shared.integrals import Error
from surrogym_shared.kinds import Function, LagKind
from surrogym_shared.rates import Rate, rates
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, Lag, Term, limits
from surrogym_shared.spec.actions import Action
from surrogym_shared.spec.safety import NamedFallback

Array = NDArray[np.float64]
Activation = Literal["none", "tanh", "relu"]

# bits of a controller's status, one for each kind of fault; 0 means that the policy acts
NOT_FINITE, OUT_OF_RANGE, LATE, NO_ACTION = 1, 2, 4, 8
LIMITED = 16  # status of a step in which the fallback for the specification's limits acts instead of the policy
PERIODS = 2  # default timeout, in sampling periods; above 1, because the duration of a period varies
# largest absolute value of a number in a controller, so that sums of a few such numbers fit in a C float
LARGEST = 1e37
SHORTEST = 1e-6  # smallest period, and smallest timeout, that a controller may have, in seconds
MOST_WEIGHTS = 1_000_000  # largest number of weights of a network: 8 MB in double, and about 20 MB of source
# without --range, the reading of an angle is valid up to this number of turns; wrapping more turns loses digits
TURNS = 100


class NotDeployable(SurrogymClientError):
    """The policy can't be converted to a controller for this target."""


@dataclass(frozen=True)
class Measurement:
    """A coordinate that the caller measures.

    Attributes:
        name: the coordinate's name.
        unit: the coordinate's unit.
        place: the coordinate's index.
        angle: whether it is wrapped to [-pi, pi).
        low, high: bounds to which it is clipped; infinite without bounds.
        lowest, highest: range of valid readings; outside of it, the controller uses its fallback action.
    """

    name: str
    unit: str
    place: int
    angle: bool
    low: float
    high: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class Remembered:
    """A lag, or an integral: a coordinate that the controller computes from earlier measurements or actions.

    Attributes:
        name: the coordinate's name.
        place: the coordinate's index.
        kind: what is repeated: an ``action``, an earlier ``value`` or ``change``, or the number of ``steps``; or
            ``sum``, the integral of the error of a coordinate, which a fault holds.
        source: index of the repeated coordinate; entry of the action for kind ``action``; -1 for ``steps``.
        angle: whether the repeated coordinate is an angle, so that a change is at most half a turn.
        of_action: whether the lag repeats actions. Other lags begin again at ``start`` after a fault, because a
            measurement is missing.
        start: the lag's value before the first measurement.
        low, high: bounds to which it is clipped; infinite without bounds.
        set_point, unit: of a ``sum``: an error of ``unit`` from the set point adds 1 in a step.
    """

    name: str
    place: int
    kind: LagKind | Literal["sum"]
    source: int
    angle: bool
    of_action: bool
    start: float
    low: float
    high: float
    set_point: float = 0.0
    unit: float = 1.0


@dataclass(frozen=True)
class Part:
    """One summand of an observation entry: coefficient * phi(sum of weight * q[place]), with phi = 1, the identity, sin
    or cos."""

    function: Function
    coefficient: float
    weights: tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Observed:
    """An entry of the observation: the sum of its parts, clipped to [low, high], which are infinite without a clip.

    ``smallest`` and ``largest`` are the entry's limits in the observation space. They are only documented; nothing is
    clipped to them.
    """

    name: str
    unit: str
    parts: tuple[Part, ...]
    low: float
    high: float
    smallest: float
    largest: float


@dataclass(frozen=True, eq=False)
class Dense:
    """A layer of the network: activation(x @ weights + bias)."""

    weights: Array  # (I, O) weight of each of I inputs for each of O outputs
    bias: Array  # (O,) constant that is added to each of O outputs
    activation: Activation


@dataclass(frozen=True, eq=False)
class Decision:
    """The policy's network.

    x = clip((o - mean) / deviation, -clip, clip), y = layers(x). For a discrete action, ``counts`` splits y into one
    group for each entry, and the index of the group's largest output is chosen. A continuous action is centre + reach *
    tanh(y), or without the tanh if ``squash`` is false.
    """

    mean: Array  # (D,) mean of each of D observation entries, which is subtracted before the first layer
    deviation: Array  # (D,) standard deviation of each observation entry, by which it is divided before the first layer
    clip: float  # largest absolute value of a standardised entry; infinite without a clip
    layers: tuple[Dense, ...]
    counts: tuple[int, ...]  # number of choices of each entry of a discrete action; empty for a continuous one
    squash: bool
    centre: Array  # (F,) middle of the range of each of F continuous action entries; empty for a discrete action
    reach: Array  # (F,) half the width of the range of each continuous action entry; empty for a discrete action


@dataclass(frozen=True)
class KeptLimit:
    """A limit of the specification: the range [low, high] in which a term of the coordinates must stay. A missing end
    is infinite.

    Attributes:
        term: the term, with the name of the limit.
        low, high: ends of the range.
        margin: distance from an end within which the fallback acts instead of the policy.
    """

    term: Observed
    low: float
    high: float
    margin: float


@dataclass(frozen=True)
class Guard:
    """Limits that the controller keeps. ``fallback`` (F functions of the coordinates) gives the action instead of the
    policy if a limit would be left soon, as ``surrogym_shared.limits.falls_back`` defines it."""

    limits: tuple[KeptLimit, ...]
    fallback: tuple[Observed, ...]


@dataclass(frozen=True, eq=False)
class Controller:
    """A policy with everything around it: one call per sampling period, from R measurements to F action entries.

    Each call first checks the measurements; on a fault it returns ``fallback``. Otherwise it puts the wrapped and
    clipped measurements and the lags into the C coordinates, computes the observation, evaluates the network, and clips
    the action to [low, high]. Index i of n choices becomes low + i * (high - low) / (n - 1), which is i itself for a
    discrete action. ``surrogym_trainer.deployment.reference`` implements this in NumPy.

    Observations, and the actions that lags remember, are rounded to float32, as in training and evaluation.

    Attributes:
        name: name of the surrogate; part of file names.
        coordinates: names of all C coordinates.
        measurements: the measured coordinates, in the order of the specification.
        lags: the other coordinates.
        observation: the D entries of the observation.
        decision: the policy's network.
        low, high: limits (F,) of the action; first and last number of a discrete one.
        fallback: action (F,) on a fault.
        timeout: largest age of a measurement in seconds; infinite without one.
        period: seconds between decisions; None if it is not declared.
        digests: SHA-256 of policy and specification and, if the card has it, the hash of the model's samples.
        guard: the limits that it keeps; None without limits.
        rates: largest changes of entries of the action in one step. A larger change is cut off, also that of a fallback
            action.
    """

    name: str
    coordinates: tuple[str, ...]
    measurements: tuple[Measurement, ...]
    lags: tuple[Remembered, ...]
    observation: tuple[Observed, ...]
    decision: Decision
    low: Array
    high: Array
    fallback: Array
    timeout: float
    period: float | None
    digests: dict[str, str]
    guard: Guard | None = None
    rates: tuple[Rate, ...] = ()

    @property
    def counts(self) -> tuple[int, ...]:
        return self.decision.counts

    @property
    def late(self) -> str:
        """Text that says at which ages a measurement counts as a fault."""
        if np.isfinite(self.timeout):
            return f"older than {self.timeout:g} s"
        return "of a negative age (no timeout was given)"


@dataclass(frozen=True)
class Choices:
    """A person's settings for a controller; None takes the default.

    Attributes:
        fallback: action (F,) on a fault. Default: the continuous action nearest to 0. A discrete one has no default.
        timeout: largest age of a measurement in seconds. Default: two sampling periods, if the period is declared.
        period: seconds between two decisions. Default: ``sampling_period`` of the specification, which it can't change.
        ranges: smallest and largest valid reading, by measurement. Default: the range of the specification, widened by
            its own width at each end; 100 turns for an angle.
    """

    fallback: tuple[float, ...] | None = None
    timeout: float | None = None
    period: float | None = None
    ranges: dict[str, tuple[float, float]] | None = None


def controller_from(
    spec: EnvironmentSpec,
    decision: Decision,
    name: str,
    digests: dict[str, str],
    choices: Choices,
    errors: Sequence[Error] = (),
) -> Controller:
    """Return the controller of a network and the specification that it was trained for.

    Args:
        spec: the specification.
        decision: the policy's network.
        name: name of the surrogate.
        digests: hashes of policy, specification and samples, by name.
        choices: a person's settings.
        errors: errors whose integrals the network sees after the entries of the specification's observation.

    Raises:
        NotDeployable: network and specification don't fit, a setting does not, or a number is too large for a C float.
    """
    _require_small(decision)
    low, high = np.array(spec.action.ranges, dtype=np.float64).T.copy()
    outputs = sum(spec.action.policy_counts) or len(low)
    shape, expected = (
        (len(decision.mean), len(decision.layers[-1].bias)),
        (len(spec.observation) + len(errors), outputs),
    )
    if shape != expected or decision.counts != spec.action.policy_counts:
        raise NotDeployable(
            f"expected a network of {expected[0]} inputs and {expected[1]} outputs for this specification, got "
            f"{shape[0]} and {shape[1]}: give the specification that the policy was trained for, with --spec"
        )
    period, integrals = _period(spec, choices.period), _integrals(spec, errors)
    made = Controller(
        name=name,
        coordinates=(*spec.coordinate_names, *(one.name for one in integrals)),
        measurements=_measurements(spec, dict(choices.ranges or {})),
        lags=(
            *(_remembered(spec, i, c, c.lag) for i, c in enumerate(spec.coordinates) if c.lag is not None),
            *integrals,
        ),
        observation=(
            *(_observed(spec, i) for i in range(len(spec.observation))),
            *(_shown(one) for one in integrals),
        ),
        decision=decision,
        low=low,
        high=high,
        fallback=_fallback(spec.action, low, high, choices.fallback),
        timeout=_timeout(period, choices.timeout),
        period=period,
        digests=digests,
        guard=_guard(spec, low, high),
        rates=rates(spec),
    )
    _require_in_float("a specification", [number for number in _numbers(made) if np.isfinite(number)])
    return made


def _numbers(controller: Controller) -> Iterator[float]:
    """Yield all numbers of a controller except the network's; infinite ones mean that there is no limit."""
    for measurement in controller.measurements:
        yield from (measurement.low, measurement.high)
    for entry in controller.observation:
        yield from (entry.low, entry.high)
    for lag in controller.lags:
        yield from (lag.start, lag.low, lag.high, lag.set_point, lag.unit)
    for part in (part for entry in controller.observation for part in entry.parts):
        yield from (part.coefficient, *(weight for _, weight in part.weights))
    yield from (*controller.low, *controller.high, *controller.fallback)
    yield from (rate.change for rate in controller.rates)
    for limit in controller.guard.limits if controller.guard else ():
        yield from (limit.low, limit.high, limit.margin, *_constants(limit.term))
    for term in controller.guard.fallback if controller.guard else ():
        yield from _constants(term)


def _constants(term: Observed) -> Iterator[float]:
    for part in term.parts:
        yield from (part.coefficient, *(weight for _, weight in part.weights))


def _require_small(decision: Decision) -> None:
    """Raise ``NotDeployable`` if a network is too large for a controller, or has numbers that a C float can't
    represent."""
    layers = [array for layer in decision.layers for array in (layer.weights, layer.bias)]
    size = sum(array.size for array in layers)
    if size > MOST_WEIGHTS:
        raise NotDeployable(
            f"expected a network of at most {MOST_WEIGHTS:,} weights, got {size:,}, which need {8 * size // 10**6} MB: "
            "surrogym export-policy writes it for a larger machine"
        )
    # the inverse of a smaller deviation would be too large for a C float
    if not (decision.deviation >= 1 / LARGEST).all():
        raise NotDeployable(
            "expected standard deviations of the observations above 0 in the policy, got one that is 0 or almost 0: "
            "train the policy without the entries that never change"
        )
    arrays = (decision.mean, decision.deviation, decision.centre, decision.reach, *layers)
    _require_in_float("a policy", *arrays)


def _require_in_float(what: str, *arrays: Any) -> None:
    """Raise ``NotDeployable`` if arrays contain numbers that are not finite, or too large for a C float."""
    for values in map(np.ravel, arrays):
        if len(wrong := values[~(np.abs(values) <= LARGEST)]):
            raise NotDeployable(
                f"expected finite numbers up to {LARGEST:g}, the range of a C float, in {what}, got {wrong[0]:g}: "
                "scale them"
            )


def _measurements(spec: EnvironmentSpec, ranges: dict[str, tuple[float, float]]) -> tuple[Measurement, ...]:
    names = [c.name for c in spec.coordinates if c.lag is None]
    if unknown := sorted(set(ranges) - set(names)):
        raise NotDeployable(
            f"--range: expected the name of a measurement ({', '.join(names)}), got {', '.join(unknown)}"
        )
    found = []
    for place, c in enumerate(spec.coordinates):
        if c.lag is not None:
            continue
        lowest, highest = ranges.get(c.name) or _readable(c)
        if not -LARGEST <= lowest < highest <= LARGEST:
            raise NotDeployable(
                f"--range of {c.name}: expected the smaller number first, both within {-LARGEST:g} to {LARGEST:g}, got "
                f"{lowest:g} to {highest:g}"
            )
        found.append(Measurement(c.name, c.unit, place, c.kind == "angle", *_bounds(c), lowest, highest))
    return tuple(found)


def _readable(coordinate: Coordinate) -> tuple[float, float]:
    """Return the default range of valid readings. It is much wider than the sampling range, because a reading outside
    of that range need not be a fault of the sensor."""
    if coordinate.kind == "angle":
        return -2 * np.pi * TURNS, 2 * np.pi * TURNS
    low, high = coordinate.settable
    return low - (high - low), high + (high - low)


def _bounds(coordinate: Coordinate) -> tuple[float, float]:
    bounds = coordinate.bounds
    low = None if bounds is None else bounds.low
    high = None if bounds is None else bounds.high
    return -np.inf if low is None else low, np.inf if high is None else high


def _remembered(spec: EnvironmentSpec, place: int, coordinate: Coordinate, lag: Lag) -> Remembered:
    names = spec.coordinate_names
    source = {"action": lag.entry or 0, "steps": -1}.get(lag.kind, names.index(lag.of) if lag.of else -1)
    root: Lag | None = lag
    while root is not None and root.kind == "value":
        root = spec.coordinates[names.index(root.of or "")].lag
    return Remembered(
        name=coordinate.name,
        place=place,
        kind=lag.kind,
        source=source,
        angle=lag.kind == "change" and spec.coordinates[source].kind == "angle",
        of_action=root is not None and root.kind == "action",
        start=0.0 if coordinate.counted else sum(limits(spec.start[coordinate.name])) / 2,
        low=_bounds(coordinate)[0],
        high=_bounds(coordinate)[1],
    )


def _integrals(spec: EnvironmentSpec, errors: Sequence[Error]) -> tuple[Remembered, ...]:
    """Return the integrals of errors as coordinates after those of the specification."""
    names = spec.coordinate_names
    return tuple(
        Remembered(
            name=f"integral of {error.name}",
            place=len(names) + i,
            kind="sum",
            source=names.index(error.name),
            angle=False,
            of_action=False,
            start=0.0,
            low=-1.0,
            high=1.0,
            set_point=error.set_point,
            unit=error.unit,
        )
        for i, error in enumerate(errors)
    )


def _shown(integral: Remembered) -> Observed:
    part = Part("linear", 1.0, ((integral.place, 1.0),))
    return Observed(integral.name, "", (part,), -np.inf, np.inf, integral.low, integral.high)


def _guard(spec: EnvironmentSpec, low: Array, high: Array) -> Guard | None:
    """Return the limits of a specification with its fallback, whose actions are clipped to the range from low (F,) to
    high (F,). None if the specification has no limits."""
    if spec.limits is None:
        return None
    limits = (
        KeptLimit(
            _computed(spec, limit.name, limit.term, *_ends(limit.term.low, limit.term.high)),
            *_ends(limit.low, limit.high),
            limit.margin,
        )
        for limit in spec.limits.keep
    )
    if isinstance(spec.limits.fallback, NamedFallback):
        raise NotDeployable(
            f"limits: expected a fallback of terms, got the program {spec.limits.fallback.name!r}, which a controller "
            "does not have: declare terms, and train again"
        )
    fallback = []
    for entry, (term, least, most) in enumerate(zip(spec.limits.fallback, low, high, strict=True)):
        begin, end = np.clip(_ends(term.low, term.high), least, most)
        fallback.append(_computed(spec, f"fallback {entry}", term, float(begin), float(end)))
    return Guard(tuple(limits), tuple(fallback))


def _computed(spec: EnvironmentSpec, name: str, term: Term, low: float, high: float) -> Observed:
    """Return a term of the coordinates, clipped to [low, high], as the controller computes it."""
    return Observed(name, "", _parts(spec, term), low, high, -np.inf, np.inf)


def _ends(low: float | None, high: float | None) -> tuple[float, float]:
    return -np.inf if low is None else low, np.inf if high is None else high


def _parts(spec: EnvironmentSpec, term: Term) -> tuple[Part, ...]:
    names = spec.coordinate_names
    return tuple(
        Part(p.function, p.coefficient, tuple((names.index(n), w) for n, w in p.weights.items())) for p in term.parts
    )


def _observed(spec: EnvironmentSpec, index: int) -> Observed:
    entry, parts = spec.observation[index], _parts(spec, spec.observation[index].term)
    limited = [(-np.inf if a is None else a, np.inf if b is None else b) for a, b in _clips(entry.term, entry)]
    return Observed(entry.name, _unit(spec, entry.term), parts, *limited[0], *limited[1])


def _clips(term: Term, entry: Any) -> tuple[tuple[float | None, float | None], ...]:
    return (term.low, term.high), (entry.low, entry.high)


def _unit(spec: EnvironmentSpec, term: Term) -> str:
    """Return the unit of a term that is a single coordinate; empty for other terms."""
    if len(term.parts) != 1 or term.parts[0].function != "linear" or len(term.parts[0].weights) != 1:
        return ""
    (name,) = term.parts[0].weights
    return spec.coordinates[spec.coordinate_names.index(name)].unit


def _fallback(action: Action, low: Array, high: Array, chosen: tuple[float, ...] | None) -> Array:
    if chosen is None:
        if not isinstance(action, BoxAction):
            raise NotDeployable(
                f"a discrete action has no neutral value: expected --fallback with {len(low)} of the numbers "
                f"{low.astype(int).tolist()} to {high.astype(int).tolist()}, which the controller takes on a fault"
            )
        return np.clip(np.zeros(len(low)), low, high)
    given = np.array(chosen, dtype=np.float64)
    whole = isinstance(action, BoxAction) or (given == np.round(given)).all()
    if given.shape != low.shape or not whole or not ((given >= low) & (given <= high)).all():
        raise NotDeployable(
            f"--fallback: expected {len(low)} entries from {low.tolist()} to {high.tolist()}, got {given.tolist()}"
        )
    return given


def _period(spec: EnvironmentSpec, chosen: float | None) -> float | None:
    declared = spec.sampling_period
    if chosen is None:
        return declared
    _require_seconds("period", chosen)
    if declared is not None and declared != chosen:
        raise NotDeployable(
            f"expected the period that the specification declares, {declared:g} s, got {chosen:g}: leave "
            "--period out, or train a policy for the other period"
        )
    return chosen


def _timeout(period: float | None, chosen: float | None) -> float:
    if chosen is not None:
        _require_seconds("timeout", chosen)
        return chosen
    return np.inf if period is None else PERIODS * period


def _require_seconds(what: str, seconds: float) -> None:
    if not SHORTEST <= seconds <= LARGEST:
        raise NotDeployable(f"--{what}: expected {SHORTEST:g} s to {LARGEST:g} s, got {seconds:g}")
