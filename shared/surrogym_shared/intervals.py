"""95 % intervals of a mean (such as the mean return of episodes) and of a share (such as that of successes)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

RESAMPLES = 2_000
QUANTILES = (0.025, 0.975)
Z = 1.959964  # 95 % of a standard normal distribution lie within plus and minus this value


class Interval(NamedTuple):
    low: float
    high: float


def of_mean(values: Sequence[float]) -> Interval | None:
    """Return the 95 % interval of the mean, by a bootstrap with a fixed seed; None for fewer than two values.

    Returns of episodes are often skewed, so no normal distribution is assumed.
    """
    if len(values) < 2:
        return None
    array = np.asarray(values, dtype=np.float64)
    rows = max(1, 2**20 // len(array))  # number of bootstrap samples that are computed at once, which take 8 MB
    rng = np.random.default_rng(0)
    means = np.concatenate(
        [
            array[rng.integers(len(array), size=(min(rows, RESAMPLES - first), len(array)))].mean(1)
            for first in range(0, RESAMPLES, rows)
        ]
    )
    low, high = np.quantile(means, QUANTILES)
    return Interval(float(low), float(high))


def of_share(successes: int, trials: int) -> Interval | None:
    """Return the 95 % interval of a share of successes, by Wilson's score; None without trials. For example, 100
    successes in 100 trials give the interval from 0.963 to 1."""
    if not trials:
        return None
    share, spread = successes / trials, Z**2 / trials
    middle = (share + spread / 2) / (1 + spread)
    reach = Z * math.sqrt(share * (1 - share) / trials + spread / (4 * trials)) / (1 + spread)
    return Interval(max(0.0, middle - reach), min(1.0, middle + reach))
