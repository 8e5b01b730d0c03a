"""Search for the region where a model is uncertain about an output: a range of one coordinate or action entry.

Of all ranges of all inputs, the one is chosen with the largest difference between its share of the model uncertainty
and its share of the Monte Carlo points (Youden's index). If this difference is small, the model uncertainty is spread
over the whole sampling range, and there is no region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points

# A region is reported only if its share of the total model uncertainty exceeds its share of the points by at least
# this.
LEAST_GAIN = 0.5
LEAST_DOUBT = 1e-12  # if the mean model uncertainty is below this, no region is searched for


@dataclass(frozen=True)
class Region:
    """Part of the sampling range: the points where one input is in a range. If ``low`` or ``high`` is None, the range
    has no such end."""

    input: str  # name of the input: a coordinate or an entry of the action
    low: float | None
    high: float | None
    outside: bool  # whether the region is everything outside [low, high]; then both ends are numbers
    share: float  # share of the total model uncertainty that lies in the region


def regions_of(definition: EnvironmentDefinition, points: Points, doubt: Tensor) -> tuple[Region | None, ...]:
    """Find, for each output, a range of one input in which most of the model uncertainty of this output lies.

    Args:
        definition: gives the names of the coordinates.
        points: the m points of the Monte Carlo set.
        doubt: model uncertainty 1 - C_m of each output at these points, (m, O).

    Returns:
        One region for each output. It is None if there is hardly any uncertainty, or if no range of a single input
        contains most of it.
    """
    entries = points.u.shape[1]
    actions = ["action"] if entries == 1 else [f"action {i + 1}" for i in range(entries)]
    inputs = torch.cat([points.q, points.u.to(points.q.dtype)], 1)
    every = [*(coordinate.name for coordinate in definition.coordinates), *actions]
    return tuple(_region(inputs, doubt[:, output], every) for output in range(doubt.shape[1]))


def _region(inputs: Tensor, doubt: Tensor, names: Sequence[str]) -> Region | None:
    if float(doubt.mean()) < LEAST_DOUBT:
        return None
    share = doubt / doubt.sum()
    ranges = chain.from_iterable(_ranges(inputs[:, i], share, name) for i, name in enumerate(names))
    gain, best = max(ranges, key=lambda one: one[0])
    return best if gain >= LEAST_GAIN else None


def _ranges(values: Tensor, share: Tensor, name: str) -> list[tuple[float, Region]]:
    """Return two candidate regions of one input, each with its gain (share of the model uncertainty less share of the
    points in it): the range with the greatest gain, and the complement of the range with the smallest gain. ``values``
    (m,) are the input's values at m points, and ``share`` (m,) the shares of the model uncertainty at these points."""
    ordered, order = values.sort(stable=True)
    # True at the last of equal values. Ranges end only there, so that none separates points with equal values.
    last = torch.cat([ordered[1:] != ordered[:-1], torch.tensor([True])])
    doubt = torch.cat([torch.zeros(1, dtype=share.dtype), share[order].cumsum(0)[last]])
    gain = doubt - torch.cat([torch.zeros(1, dtype=share.dtype), (torch.arange(len(values)) + 1.0)[last] / len(values)])
    distinct = ordered[last]
    return [_range(gain, doubt, distinct, name, outside=False), _range(-gain, doubt, distinct, name, outside=True)]


def _range(gain: Tensor, doubt: Tensor, values: Tensor, name: str, *, outside: bool) -> tuple[float, Region]:
    """Find the interval of an input over which the cumulative ``gain`` (d + 1,) increases most. Return the increase,
    and as a region the interval, or its complement if ``outside``.

    Args:
        gain: (d + 1,) share of the uncertainty less share of the points, both cumulative over the sorted values.
        doubt: (d + 1,) cumulative share of the uncertainty.
        values: (d,) distinct values of the input, sorted.
        name: name of the input.
        outside: whether the region is everything outside the interval.

    Returns:
        The increase of the gain, and the region.
    """
    lowest, at = gain.cummin(0)
    end = int((gain - lowest).argmax())
    begin = int(at[end])
    low = None if begin == 0 else float((values[begin - 1] + values[begin]) / 2)
    high = None if end == len(values) else float((values[end - 1] + values[end]) / 2)
    inside = float(doubt[end] - doubt[begin])
    share = 1 - inside if outside else inside
    # The complement of a range with one end is also a range with one end, so it is returned as that range.
    if outside and (low is None or high is None):
        return float(gain[end] - gain[begin]), Region(name, high, low, False, share)
    return float(gain[end] - gain[begin]), Region(name, low, high, outside, share)
