"""The coverage of a log: how often it visits the cells of a grid over each pair of states and actions.

Shapes: n steps, K columns (states, then actions).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import BoxAction, EnvironmentSpec, limits

CELLS = 10  # a picture counts samples in a grid with this number of cells along each side
MOST_COLUMNS = 8  # a picture shows at most this number of columns, so that it stays readable

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Coverage:
    """The number of steps of a log in each cell of a grid over each pair of columns.

    Attributes:
        names: names of the columns, (K,).
        ends: smallest and largest value of each column's range, (K, 2).
        counts: for each pair of columns, the steps in each cell (CELLS, CELLS); the first index is of the first column.
    """

    names: tuple[str, ...]
    ends: Array
    counts: dict[tuple[int, int], NDArray[np.int64]]

    def share(self, pair: tuple[int, int]) -> float:
        """Return the share of a pair's cells that the log has visited."""
        return float((self.counts[pair] > 0).mean())

    @property
    def emptiest(self) -> tuple[int, int]:
        """The pair of columns with the smallest share of visited cells."""
        return min(self.counts, key=self.share)

    def words(self) -> str:
        """Return a sentence about the pair of columns with the smallest share of visited cells."""
        first, second = (self.names[i] for i in self.emptiest)
        return (
            f"coverage: at least {100 * self.share(self.emptiest):.0f} % of the cells of every two columns hold steps, "
            f"least for {first} and {second}"
        )


def coverage_of(spec: EnvironmentSpec, q: Array, u: Array) -> Coverage:
    """Count the steps of a log, states q (n, C) and actions u (n, F), in cells over the ranges of its specification."""
    action = spec.action
    names = [*spec.coordinate_names, *(f"action {i}" if action.size > 1 else "action" for i in range(action.size))]
    if isinstance(action, BoxAction):
        acting = list(zip(action.low, action.high, strict=True))
    else:
        acting = [(-0.5, n - 0.5) for n in ([action.n] if action.kind == "discrete" else action.nvec)]
    ends = np.array([*(limits(c.sampling) for c in spec.coordinates), *acting])
    values = np.concatenate([q, u], axis=1)
    shown = range(len(names))
    counts = {(i, j): _counted(values[:, [i, j]], ends[[i, j]]) for i, j in combinations(shown, 2)}
    return Coverage(tuple(names), ends, counts)


def _counted(values: Array, ends: Array) -> NDArray[np.int64]:
    counts, _, _ = np.histogram2d(values[:, 0], values[:, 1], bins=CELLS, range=ends.tolist())
    return counts.astype(np.int64)


def columns_shown(names: Sequence[str]) -> list[int]:
    """Return the indices of the columns that fit into a picture: the first coordinates, followed by the actions."""
    count = len(names)
    actions = [i for i, name in enumerate(names) if name.startswith("action")]
    states = [i for i in range(count) if i not in actions][: max(MOST_COLUMNS - len(actions), 1)]
    return [*states, *actions][:MOST_COLUMNS]
