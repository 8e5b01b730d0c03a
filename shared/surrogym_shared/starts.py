"""Comparison of the states after resets of an original environment with the declared starts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from surrogym_shared.spec import EnvironmentSpec, limits

# A state after a reset is no declared start if a coordinate is outside of its declared starts by more than this share
# of its sampling range. Less may be noise of a sensor.
FAR = 0.1


def not_declared(spec: EnvironmentSpec, states: Sequence[ArrayLike]) -> str:
    """Say how many of the states after a reset, each (C,), are no declared starts, and name the coordinate and the
    value that are farthest away. Returns "" if there is none. Lags are not compared.

    Examples:
        "2 of 3 resets led to no declared start, such as x = 1.62, where the specification declares -0.2 to 0.2"
    """
    beyond = [
        max(_beyond(spec, i, float(np.asarray(state)[i])) for i in range(len(spec.coordinates))) for state in states
    ]
    wrong = sum(excess > FAR for excess in beyond)
    if not wrong:
        return ""
    worst = np.asarray(states[int(np.argmax(beyond))])
    i = max(range(len(spec.coordinates)), key=lambda i: _beyond(spec, i, float(worst[i])))
    low, high = _declared(spec, i)
    declared = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    return (
        f"{wrong} of {len(states)} resets led to no declared start, such as {spec.coordinates[i].name} = "
        f"{float(worst[i]):.4g}, where the specification declares {declared}"
    )


def _declared(spec: EnvironmentSpec, i: int) -> tuple[float, float]:
    if spec.starts:
        values = [start[i] for start in spec.starts]
        return min(values), max(values)
    return limits(spec.start[spec.coordinates[i].name])


def _beyond(spec: EnvironmentSpec, i: int, value: float) -> float:
    """Return the distance of a value from the declared starts of coordinate ``i``, as a share of its sampling range; 0
    if it is one of them, or if nothing is known of it."""
    coordinate = spec.coordinates[i]
    if coordinate.lag is not None or not math.isfinite(value):
        return 0.0
    low, high = _declared(spec, i)
    away = value - (low + high) / 2
    if coordinate.kind == "angle":
        away = math.remainder(away, 2 * math.pi)
    least, most = limits(coordinate.sampling)
    return max(abs(away) - (high - low) / 2, 0.0) / (most - least)
