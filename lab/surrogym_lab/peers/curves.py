"""Learning curves over seeds: interquartile mean of the real return after so many real steps, with an interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from surrogym_lab.peers.points import Point
from surrogym_lab.reproduce.statistics import bootstrap_interval
from surrogym_trainer.evaluation.evaluator import interquartile_mean

Array = NDArray[np.float64]
FEW = 3  # seeds; fewer give no useful interval


@dataclass(frozen=True)
class Curve:
    """One method on one task.

    Attributes:
        steps: real steps (n,), from the first at which every seed has a policy.
        middle: interquartile mean (n,) over seeds.
        low, high: 95 % bootstrap interval (n,); None with fewer than three seeds.
    """

    steps: Array
    middle: Array
    low: Array | None = None
    high: Array | None = None


def curve(points: Sequence[Point]) -> Curve | None:
    """Learning curve of one method on one task; None if a seed has no result at all.

    Between two rounds a seed has the return of its last round, also after its last one.
    """
    seeds = [[p for p in of if p.mean is not None] for of in by_seed(points).values()]
    if not seeds or not all(seeds):
        return None
    begin = max(rounds[0].real_steps for rounds in seeds)
    steps = np.array(sorted({p.real_steps for rounds in seeds for p in rounds if p.real_steps >= begin}), dtype=float)
    returns = np.stack([_held(rounds, steps) for rounds in seeds])  # (seeds, n)
    middle = np.array([interquartile_mean(column) for column in returns.T])
    if len(seeds) < FEW:
        return Curve(steps, middle)
    low, high = np.array([bootstrap_interval(column) for column in returns.T]).T
    return Curve(steps, middle, low, high)


def by_seed(points: Sequence[Point]) -> dict[int, list[Point]]:
    """Points of each seed in the order of their rounds."""
    ordered = sorted(points, key=lambda p: (p.seed, p.round))
    return {seed: list(of) for seed, of in groupby(ordered, key=lambda p: p.seed)}


def by_method(points: Sequence[Point]) -> dict[tuple[str, str], list[Point]]:
    """Points by task and method, in the order in which they first occur."""
    found: dict[tuple[str, str], list[Point]] = {}
    for point in points:
        found.setdefault((point.task, point.method), []).append(point)
    return found


def _held(rounds: Sequence[Point], steps: Array) -> Array:
    """Return (n,) of the last round at or before each of the real steps (n,)."""
    at = np.searchsorted([p.real_steps for p in rounds], steps, side="right") - 1
    return np.array([float(rounds[i].mean or 0.0) for i in at])
