"""Statistics over few seeds: interquartile mean, and intervals by resampling.

R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surrogym_client.evaluation.evaluator import interquartile_mean

Array = NDArray[np.float64]

RESAMPLES = 2_000
PERCENTILES = (2.5, 97.5)


def bootstrap_interval(values: Array) -> tuple[float, float]:
    """95 % percentile interval of the interquartile mean of values (n,), by resampling them."""
    return _interval(_resampled(values, np.random.default_rng(0)))


def difference_interval(first: Array, second: Array) -> tuple[float, float]:
    """The same for the interquartile mean of first (n,) minus that of second (m,), resampled independently."""
    rng = np.random.default_rng(0)
    return _interval(_resampled(first, rng) - _resampled(second, rng))


def _resampled(values: Array, rng: np.random.Generator) -> Array:
    return np.array([interquartile_mean(sample) for sample in rng.choice(values, (RESAMPLES, len(values)))])


def _interval(statistics: Array) -> tuple[float, float]:
    low, high = np.percentile(statistics, PERCENTILES)
    return float(low), float(high)
