"""Find the end of a sampling range that a policy's way passes often. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.kinds import Side
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.coordinates import Coordinate, limits
from surrogym_trainer.policies.evidence import RangeLeft

LITTLE = 0.05  # share of a way that may lie beyond an end
MOST_UNTESTABLE = 0.2  # share of a way that may lie beyond what the original environment can be set to
SIDES: tuple[Side, ...] = ("lower", "upper")

Array = NDArray[np.float64]


def range_left(spec: EnvironmentSpec, q: Array) -> RangeLeft | None:
    """Return the end that most states q (m, C) of a way are beyond; None if at most ``LITTLE`` of them are.

    Angles have no end, and constants and lags follow from the rest.
    """
    found = [_left(coordinate, values, side) for coordinate, values in _with_ends(spec, q) for side in SIDES]
    worst = max(found, key=lambda one: one.share, default=None)
    return worst if worst is not None and worst.share > LITTLE else None


def untestable(spec: EnvironmentSpec, q: Array) -> tuple[str, float] | None:
    """Return the coordinate that most states q (m, C) of a way have beyond what the original environment can be set to,
    and their share: no audit can test these states. None if at most ``MOST_UNTESTABLE`` of the states are such, or if
    the environment can't be set to any state. Coordinates as for ``range_left``."""
    if spec.query == "rollout":
        return None
    found = [(coordinate.name, _beyond(coordinate.settable, values)) for coordinate, values in _with_ends(spec, q)]
    worst = max(found, key=lambda one: one[1], default=None)
    return worst if worst is not None and worst[1] > MOST_UNTESTABLE else None


def _with_ends(spec: EnvironmentSpec, q: Array) -> list[tuple[Coordinate, Array]]:
    """Return the coordinates that have ends, each with its values (m,)."""
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
