"""Other set points for a declared reward: the reward of the specification with one number replaced for each of them.

A reward measures the error of a coordinate by a quantity such as (level - 10) / 2. The set point is the value of the
coordinate at which this quantity is 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from surrogym_shared.checks import require
from surrogym_shared.spec import (
    Coordinate,
    DeclaredReward,
    EnvironmentSpec,
    Inequality,
    Part,
    Quantity,
    Reward,
    Term,
    limits,
)
from surrogym_shared.terms import holds

SAME = 1e-9  # set points that differ by at most this share of the coordinate's sampling range are equal


class Rewarded(Protocol):
    """What set points depend on; a specification has it, and so has a server's definition of an environment."""

    @property
    def coordinates(self) -> Sequence[Coordinate]: ...
    @property
    def coordinate_names(self) -> tuple[str, ...]: ...
    @property
    def reward(self) -> Reward | DeclaredReward: ...
    @property
    def termination_groups(self) -> tuple[tuple[Inequality, ...], ...]: ...


def set_points_of(environment: Rewarded) -> dict[str, tuple[float, ...]]:
    """Return the values at which a declared reward measures no error, by the coordinate's name. Empty if the reward is
    learned. Values that differ by a rounding error are one."""
    found: dict[str, list[float]] = {}
    for quantity in _quantities(environment.reward):
        if (error := _error(quantity)) is not None:
            name, slope, constant = error
            value, known = -constant / slope + 0.0, found.setdefault(name, [])
            low, high = _range(environment, name)
            if all(abs(value - other) > SAME * (high - low) for other in known):
                known.append(value)
    return {name: tuple(sorted(values)) for name, values in found.items()}


def _range(environment: Rewarded, name: str) -> tuple[float, float]:
    """Return the sampling range of a coordinate."""
    return limits(environment.coordinates[environment.coordinate_names.index(name)].sampling)


def reward_for(environment: Rewarded, points: Mapping[str, float]) -> DeclaredReward:
    """Return the declared reward with other set points.

    Args:
        environment: specification of the original environment.
        points: new set points, by the names of coordinates.

    Raises:
        ValueError: the reward is learned, it has no single set point of this name, or the model does not support the
            new value: it lies outside of the sampling range, or a condition of the reward or a termination holds at
            only one of the old and the new value.
    """
    reward = environment.reward
    if not isinstance(reward, DeclaredReward):
        raise ValueError(
            "set points: expected a specification that declares the reward, got one whose reward is learned from "
            "samples: declare the reward, or register the environment with rewards of the other set point"
        )
    for name, value in points.items():
        _check(environment, name, value)
    terms = tuple(
        term
        if term.shape == "linear"
        else term.model_copy(update={"of": tuple(_moved(quantity, points) for quantity in term.of)})
        for term in reward.terms
    )
    return reward.model_copy(update={"terms": terms})


def with_set_points(spec: EnvironmentSpec, points: Mapping[str, float]) -> EnvironmentSpec:
    """Return a specification whose reward has other set points. It has no criteria of success, because those belong to
    the old set points. Without ``points``, the specification is returned as it is.

    Raises:
        ValueError: as ``reward_for``.
    """
    return spec.model_copy(update={"reward": reward_for(spec, points), "success": None}) if points else spec


def _check(environment: Rewarded, name: str, value: float) -> None:
    """Raise ``ValueError`` if a set point can't be ``value``."""
    known = set_points_of(environment)
    if name not in known:
        among = f" ({', '.join(map(repr, known))})" if known else ", which this reward does not have"
        raise ValueError(
            f"set points: expected a coordinate whose error the declared reward measures by itself{among}, got {name!r}"
        )
    column, (low, high), old = environment.coordinate_names.index(name), _range(environment, name), known[name]
    require(
        len(old) == 1,
        f"set point {name!r}: expected a reward with one set point of {name!r}, got one with several: "
        f"{', '.join(f'{one:g}' for one in old)}",
    )
    require(
        not isinstance(value, bool) and isinstance(value, int | float) and low <= value <= high,
        f"set point {name!r}: expected a number in the sampling range, {low:g} to {high:g}, where the model has "
        f"samples, got {value!r}",
    )
    states = np.zeros((2, len(environment.coordinates)))
    states[:, column] = old[0], value
    for kind, condition in _conditions(environment):
        names = {one for part in condition.term.parts for one, weight in part.weights.items() if weight}
        if names == {name}:
            before, after = holds(environment, condition, states).tolist()
            require(
                before == after,
                f"set point {name!r}: expected a value at which {kind} of {name!r} holds as it does at the present set "
                f"point, {old[0]:g}, because set points move no conditions, got {value:g}",
            )


def _conditions(environment: Rewarded) -> Iterator[tuple[str, Inequality]]:
    reward = environment.reward
    for term in reward.terms if isinstance(reward, DeclaredReward) else ():
        yield from (("a condition of the reward", one) for one in term.when)
    for group in environment.termination_groups:
        yield from (("a termination", one) for one in group)


def _quantities(reward: Reward | DeclaredReward) -> Iterator[Quantity]:
    """Yield the quantities whose size a declared reward measures."""
    if isinstance(reward, DeclaredReward):
        for term in reward.terms:
            yield from term.of if term.shape != "linear" else ()


def _error(quantity: Quantity) -> tuple[str, float, float] | None:
    """Return the coordinate's name, the slope and the constant of a quantity slope * coordinate + constant that can be
    0 within the limits of its term; None for other quantities."""
    term = quantity.term
    if term is None or any(quantity.action):
        return None
    one_sided = (term.low is not None and term.low >= 0) or (term.high is not None and term.high <= 0)
    return None if one_sided else line_of(term)


def line_of(term: Term) -> tuple[str, float, float] | None:
    """Return the coordinate's name, the slope and the constant of a term slope * coordinate + constant; None for other
    terms. Limits of the term are ignored."""
    if any(part.function not in ("one", "linear") for part in term.parts):
        return None
    slopes: dict[str, float] = {}
    for part in term.parts:
        for name, weight in part.weights.items():
            slopes[name] = slopes.get(name, 0.0) + part.coefficient * weight
    slopes = {name: slope for name, slope in slopes.items() if slope}
    if len(slopes) != 1:
        return None
    ((name, slope),) = slopes.items()
    constant = math.fsum(part.coefficient for part in term.parts if part.function == "one")
    return name, slope, constant


def _moved(quantity: Quantity, points: Mapping[str, float]) -> Quantity:
    """Return a quantity with the constant that makes it 0 at the new set point of its coordinate, if it has one."""
    error = _error(quantity)
    if error is None or error[0] not in points:
        return quantity
    name, slope, _ = error
    assert quantity.term is not None
    kept = tuple(part for part in quantity.term.parts if part.function != "one")
    constant = Part(function="one", coefficient=-slope * points[name])
    return quantity.model_copy(update={"term": quantity.term.model_copy(update={"parts": (*kept, constant)})})
