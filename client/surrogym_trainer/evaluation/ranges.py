"""Search for an end of a sampling range that a policy often exceeds. All functions are pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.kinds import Side
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.coordinates import Coordinate, limits
from surrogym_trainer.policies.evidence import RangeLeft

LITTLE = 0.05  # no warning is given if at most this share of a policy's states lies beyond an end of a sampling range
# no warning is given if the original environment can be set to all but this share of a policy's states
MOST_UNTESTABLE = 0.2
SIDES: tuple[Side, ...] = ("lower", "upper")

Array = NDArray[np.float64]


def range_left(spec: EnvironmentSpec, q: Array) -> RangeLeft | None:
    """Return the end of a sampling range that a policy's states q (m, C) exceed most often; None if no end is exceeded
    by more than a share of ``LITTLE`` of the states.

    Angles have no ends. Constants and lags are not tested, because they follow from the other coordinates.
    """
    found = [_left(coordinate, values, side) for coordinate, values in _with_ends(spec, q) for side in SIDES]
    worst = max(found, key=lambda one: one.share, default=None)
    return worst if worst is not None and worst.share > LITTLE else None


def untestable(spec: EnvironmentSpec, q: Array) -> tuple[str, float] | None:
    """Return the coordinate that most often prevents the original environment from being set to a policy's states q (m,
    C), and the share of these states, which no audit can test.

    None if the share is at most ``MOST_UNTESTABLE``, or if the environment can't be set to any state. Angles, constants
    and lags are left out.
    """
    if spec.query == "rollout":
        return None
    found = [(coordinate.name, _beyond(coordinate.settable, values)) for coordinate, values in _with_ends(spec, q)]
    worst = max(found, key=lambda one: one[1], default=None)
    return worst if worst is not None and worst[1] > MOST_UNTESTABLE else None


def _with_ends(spec: EnvironmentSpec, q: Array) -> list[tuple[Coordinate, Array]]:
    """Return the coordinates whose sampling range has ends, each with its values (m,)."""
    return [(c, q[:, i]) for i, c in enumerate(spec.coordinates) if c.kind == "linear" and c.moves]


def _beyond(ends: tuple[float, float], values: Array) -> float:
    return float(((values < ends[0]) | (values > ends[1])).mean())


def _left(coordinate: Coordinate, values: Array, side: Side) -> RangeLeft:
    low, high = limits(coordinate.sampling)
    end, beyond = (low, values < low) if side == "lower" else (high, values > high)
    farthest = values.min() if side == "lower" else values.max()
    return RangeLeft(
        coordinate=coordinate.name, side=side, end=end, share=float(beyond.mean()), farthest=float(farthest)
    )
