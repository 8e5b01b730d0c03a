"""Evaluate terms of a specification (functions of the state) at n states of C coordinates."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec, Inequality, Part, Term

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Named(Protocol):
    """What terms are evaluated for: a specification, for example."""

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the C coordinates, in their order."""
        ...


def evaluate(spec: Named, term: Term, coordinates: Array) -> Array:
    """Return the value (n,) of a term at each of n states with coordinates (n, C)."""
    total = np.sum([_part(spec, part, coordinates) for part in term.parts], axis=0)
    if term.low is None and term.high is None:
        return np.asarray(total)
    return np.asarray(np.clip(total, term.low, term.high))


def observe(spec: EnvironmentSpec, coordinates: Array) -> Array:
    """Return the observation (n, D) of D entries that a specification declares, at n states with coordinates (n, C)."""
    return np.stack([evaluate(spec, entry.term, coordinates) for entry in spec.observation], axis=1)


def holds(spec: Named, inequality: Inequality, coordinates: Array) -> Bools:
    """Return whether an inequality holds at each of n states with coordinates (n, C), as booleans (n,)."""
    compare = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}[inequality.relation]
    return np.asarray(compare(evaluate(spec, inequality.term, coordinates), inequality.value))


def terminates(spec: EnvironmentSpec, coordinates: Array) -> Bools:
    """Return whether any declared termination holds at each of n states with coordinates (n, C), as booleans (n,)."""
    ended = np.zeros(len(coordinates), dtype=np.bool_)
    for group in spec.termination_groups:
        ended |= np.all([holds(spec, inequality, coordinates) for inequality in group], axis=0)
    return ended


def _part(spec: Named, part: Part, coordinates: Array) -> Array:
    if part.function == "one":
        return np.full(len(coordinates), part.coefficient)
    names = spec.coordinate_names
    combined = sum(weight * coordinates[:, names.index(name)] for name, weight in part.weights.items())
    angle = np.asarray(combined)
    value = {"linear": angle, "sin": np.sin(angle), "cos": np.cos(angle)}[part.function]
    return np.asarray(part.coefficient * value)
