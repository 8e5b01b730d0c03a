"""Statistics over few seeds: interquartile mean, and intervals by resampling.

R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import comb

import numpy as np
from numpy.typing import NDArray

from surrogym_trainer.evaluation.evaluator import interquartile_mean

Array = NDArray[np.float64]

RESAMPLES = 2_000
PERCENTILES = (2.5, 97.5)
TAIL, HALVINGS = 0.025, 50


def bootstrap_interval(values: Array) -> tuple[float, float]:
    """95 % percentile interval of the interquartile mean of values (n,), by resampling them."""
    return _interval(_resampled(values, np.random.default_rng(0)))


def difference_interval(first: Array, second: Array) -> tuple[float, float]:
    """95 % percentile interval of the interquartile mean of first (n,) minus that of second (m,).

    Both are resampled independently.
    """
    rng = np.random.default_rng(0)
    return _interval(_resampled(first, rng) - _resampled(second, rng))


def clustered_interval(clusters: Sequence[Array]) -> tuple[float, float]:
    """95 % percentile interval of the mean of all values, by resampling whole clusters, each an array of values."""
    rng, sums = np.random.default_rng(0), np.array([[values.sum(), len(values)] for values in clusters])
    drawn = sums[rng.integers(len(sums), size=(RESAMPLES, len(sums)))].sum(axis=1)
    return _interval(drawn[:, 0] / drawn[:, 1])


def interval_score(low: Array, high: Array, value: Array, chance: float) -> Array:
    """Interval scores (n,) of central intervals that hold with ``chance``, in the values' unit. Lower is better.

    The width, and 2 / (1 - chance) times the distance of a value outside (Gneiting and Raftery 2007, equation 43).
    """
    outside = np.maximum(low - value, 0.0) + np.maximum(value - high, 0.0)
    return np.asarray(high - low + 2 / (1 - chance) * outside)


def exact_interval(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a share that was ``count`` of ``of`` (Clopper and Pearson 1934)."""

    def at_least(share: float, k: int) -> float:
        return sum(comb(of, i) * share**i * (1 - share) ** (of - i) for i in range(k, of + 1))

    low = 0.0 if count == 0 else _root(lambda share: at_least(share, count) - TAIL)
    high = 1.0 if count == of else _root(lambda share: at_least(share, count + 1) - (1 - TAIL))
    return low, high


def _root(rising: Callable[[float], float]) -> float:
    """Zero of a function that increases over [0, 1], by bisection."""
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < 0 else (low, middle)
    return (low + high) / 2


def _resampled(values: Array, rng: np.random.Generator) -> Array:
    return np.array([interquartile_mean(sample) for sample in rng.choice(values, (RESAMPLES, len(values)))])


def _interval(statistics: Array) -> tuple[float, float]:
    low, high = np.percentile(statistics, PERCENTILES)
    return float(low), float(high)
