"""Rates of the action: how far each entry may change from one step to the next.

The action of the last step is a coordinate, so the state alone determines which actions keep the rates. The original
environment, virtual environments and deployed controllers all limit actions by the state in this way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.checks import require
from surrogym_shared.spec import BoxAction, EnvironmentSpec

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rate:
    """Largest change of one entry of the action in one step."""

    entry: int  # index of the entry in the action
    last: int  # index of the coordinate that repeats the value of this action entry in the previous step
    change: float  # largest change in one step, in the entry's unit


def rates(spec: EnvironmentSpec) -> tuple[Rate, ...]:
    """Return the rate of each entry of the action that has one.

    Raises:
        ValueError: the sampling period is missing, or no coordinate has the last value of an entry with a rate.
    """
    return tuple(_rates(spec))


def within_rates(rates: Sequence[Rate], coordinates: Array, action: Array) -> Array:
    """Return the actions (..., F) that keep the ``rates`` and are nearest to the requested ``action`` (..., F) in
    states with ``coordinates`` (..., C), some of which have the values of the last action."""
    kept = np.array(action, dtype=np.float64)
    for rate in rates:
        last = coordinates[..., rate.last]
        kept[..., rate.entry] = np.clip(kept[..., rate.entry], last - rate.change, last + rate.change)
    return kept


def _rates(spec: EnvironmentSpec) -> Iterator[Rate]:
    action = spec.action
    if not isinstance(action, BoxAction) or action.rate is None:
        return
    period = spec.sampling_period
    require(
        period is not None, "action: a rate is a change per second: expected a sampling_period in seconds, got none"
    )
    lags = {c.lag.entry or 0: i for i, c in enumerate(spec.coordinates) if c.lag is not None and c.lag.kind == "action"}
    for entry, rate in enumerate(action.rate):
        if rate is not None and period is not None:
            require(
                entry in lags,
                f"action: expected entry {entry} of the last action among the coordinates, because it has a rate, got "
                "no such lag: add it by with_history(spec, actions=1, rate=...)",
            )
            yield Rate(entry, lags[entry], rate * period)
