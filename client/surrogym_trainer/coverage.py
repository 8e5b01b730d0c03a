"""Values over grids of two columns: how often a log visits the cells for each pair of states and actions, and maps of a
model over two coordinates. In a map, the other coordinates and the action are in the middle of their ranges.

Shapes: n steps, K columns (states, then actions), S cells along a side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import BoxAction, EnvironmentSpec, limits
from surrogym_shared.wire import SurrogateView, Uncertainty

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
        acting = [(-0.5, n - 0.5) for n in action.nvec]
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


# Returns the model's uncertainty at coordinates (n, C) and actions (n, F).
Ask = Callable[[list[list[float]], list[list[float]]], Uncertainty]

SIDE = 33


@dataclass(frozen=True)
class Cut:
    """Maps of the model over two coordinates, whose indices are ``across`` and ``up``. ``uncertainty`` has standard
    deviations as multiples of the tolerance, ``occupancy`` how often policies visit a state, and ``log_index`` the
    logarithm of the paper's uncertainty index. Each value of ``uncertainty`` and ``log_index`` is the largest over the
    outputs."""

    across: int
    up: int
    # (S, S) standard deviation as a multiple of the tolerance, at S values of each coordinate; rows go from bottom to
    # top
    uncertainty: Array
    occupancy: Array  # (S, S) density of the states that policies visit
    # (S, S) natural logarithm of the paper's uncertainty index: the uncertainty times the density of the visited states
    log_index: Array


def pairs(spec: EnvironmentSpec) -> list[tuple[int, int]]:
    """Return the indices of coordinates to show together, each coordinate once. If one is left over, it is paired with
    itself."""
    last = len(spec.coordinates) - 1
    return [(i, min(i + 1, last)) for i in range(0, last + 1, 2)]


def cuts(view: SurrogateView, ask: Ask) -> list[Cut]:
    """Return a map for each pair of coordinates; none if there is no model. ``ask`` returns the model's uncertainty."""
    if view.fidelity is None:
        return []
    tolerances = np.array([output.tolerance for output in view.fidelity.outputs])
    return [_cut(view.spec, across, up, tolerances, ask) for across, up in pairs(view.spec) if across != up]


def _cut(spec: EnvironmentSpec, across: int, up: int, tolerances: Array, ask: Ask) -> Cut:
    ends = np.array([limits(coordinate.sampling) for coordinate in spec.coordinates])
    points = np.tile(ends.mean(1), (SIDE * SIDE, 1))
    x, y = (np.linspace(ends[which, 0], ends[which, 1], SIDE) for which in (across, up))
    points[:, [across, up]] = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    said = ask(points.tolist(), np.tile(_middle(spec), (len(points), 1)).tolist())
    return Cut(
        across,
        up,
        uncertainty=(np.array(said.deviation) / tolerances).max(1).reshape(SIDE, SIDE),
        occupancy=np.array(said.input_probability)[:, 0].reshape(SIDE, SIDE),
        log_index=np.array(said.log_uncertainty_index).max(1).reshape(SIDE, SIDE),
    )


def _middle(spec: EnvironmentSpec) -> Array:
    """Return an action (F,): the middle of the bounds, or zeros if the actions are discrete."""
    action = spec.action
    if not isinstance(action, BoxAction):
        return np.zeros(action.size)
    middle: Array = np.mean([action.low, action.high], axis=0)
    return middle
