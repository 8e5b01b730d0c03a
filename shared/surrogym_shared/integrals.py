"""Integrals of errors, computed from observations: how far a coordinate was from its set point so far.

The sum of the errors since the reset is clipped to [-1, 1], so it remembers the last steps alone while the coordinate
is far from its set point. A policy that sees it can hold the set point with a weaker pump, or with an offset in the
action.

Shapes: N lanes or episodes, D observation entries, K integrals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.checks import Number, Width
from surrogym_shared.set_points import line_of, set_points_of, with_set_points
from surrogym_shared.spec import EnvironmentSpec, limits

Floats = NDArray[np.floating[Any]]
UNIT = 0.05  # error, as a share of the coordinate's sampling range, that moves an integral from 0 to an end in one step


@dataclass(frozen=True)
class Error:
    """The error of a coordinate ``name`` from its ``set_point``; an error of ``unit`` moves the integral by 1."""

    name: str
    set_point: Number
    unit: Width


def errors_of(spec: EnvironmentSpec, names: Sequence[str], set_points: Mapping[str, float]) -> tuple[Error, ...]:
    """Return the errors of coordinates from the set points of a declared reward.

    Args:
        spec: specification with a declared reward.
        names: names of the coordinates.
        set_points: set points that replace those of the reward, by coordinate.

    Raises:
        ValueError: the reward does not have a set point of a coordinate.
    """
    known, errors = set_points_of(with_set_points(spec, set_points)), []
    for name in names:
        if len(known.get(name, ())) != 1:
            raise ValueError(
                f"integral: expected a coordinate with one set point in a declared reward, "
                f"{' or '.join(map(repr, known)) or 'which this reward does not have'}, got {name!r}"
            )
        low, high = limits(spec.coordinates[spec.coordinate_names.index(name)].sampling)
        errors.append(Error(name, known[name][0], UNIT * (high - low)))
    return tuple(errors)


@dataclass(frozen=True)
class Integrals:
    """Running sums of the errors of K coordinates, computed from observations."""

    columns: NDArray[np.int64]  # (K,) observation entry that shows each coordinate
    slopes: Floats  # (K,) factor of this entry in the error
    constants: Floats  # (K,) constant in the error

    @classmethod
    def of(cls, spec: EnvironmentSpec, errors: Sequence[Error]) -> Self:
        """Return the integrals of errors.

        Args:
            spec: specification of the environment that the policy observes.
            errors: errors of K coordinates.

        Raises:
            ValueError: the observation does not show a coordinate.
        """
        shown, rows = [(i, line_of(one.term)) for i, one in enumerate(spec.observation)], []
        for error in errors:
            lines = [(i, *line[1:]) for i, line in shown if line is not None and line[0] == error.name]
            if not lines:
                raise ValueError(f"integral: expected a coordinate that an observation entry shows, got {error.name!r}")
            column, slope, constant = lines[0]
            rows.append((column, 1 / (slope * error.unit), -(constant / slope + error.set_point) / error.unit))
        columns, slopes, constants = np.array(rows, dtype=np.float64).reshape(-1, 3).T
        return cls(columns.astype(np.int64), slopes, constants)

    def after(self, sums: Floats, observation: Floats) -> Floats:
        """Return the sums (N, K) after a step that led to observations (N, D)."""
        added: Floats = np.clip(sums + observation[:, self.columns] * self.slopes + self.constants, -1.0, 1.0)
        return added


def joined(observation: Floats, sums: Floats) -> Floats:
    """Return observations (N, D) with sums (N, K) after their entries, as numbers of the observations' type."""
    return np.concatenate([observation, sums.astype(observation.dtype)], axis=1)
