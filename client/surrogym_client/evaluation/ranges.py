"""Find the end of a sampling range that a policy's way passes often. Pure."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surrogym_client.policies.evidence import RangeLeft
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.coordinates import Coordinate, limits

LITTLE = 0.05  # share of a way that may lie beyond an end
SIDES: tuple[Literal["lower", "upper"], ...] = ("lower", "upper")

Array = NDArray[np.float64]


def range_left(spec: EnvironmentSpec, q: Array) -> RangeLeft | None:
    """Return the end that most states q (m, C) of a way are beyond; None if at most ``LITTLE`` of them are.

    Angles have no end, and constants and lags follow from the rest.
    """
    moving = [(q[:, i], c) for i, c in enumerate(spec.coordinates) if c.kind == "linear" and c.moves]
    found = [_left(coordinate, values, side) for values, coordinate in moving for side in SIDES]
    worst = max(found, key=lambda one: one.share, default=None)
    return worst if worst is not None and worst.share > LITTLE else None


def _left(coordinate: Coordinate, values: Array, side: Literal["lower", "upper"]) -> RangeLeft:
    low, high = limits(coordinate.sampling)
    end, beyond = (low, values < low) if side == "lower" else (high, values > high)
    farthest = values.min() if side == "lower" else values.max()
    return RangeLeft(
        coordinate=coordinate.name, side=side, end=end, share=float(beyond.mean()), farthest=float(farthest)
    )
