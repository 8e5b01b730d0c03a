"""Maps of a model over two coordinates. The other coordinates and the action are in the middle of their ranges.

Shapes: S cells along a side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import BoxAction, EnvironmentSpec, limits
from surrogym_shared.wire import SurrogateView, Uncertainty

Array = NDArray[np.float64]
# Returns the model's uncertainty at coordinates (n, C) and actions (n, F).
Ask = Callable[[list[list[float]], list[list[float]]], Uncertainty]

SIDE = 33


@dataclass(frozen=True)
class Cut:
    """Maps of the model over two coordinates, whose indices are ``across`` and ``up``. Each value of ``uncertainty``
    and of ``log_index`` is the largest over the outputs."""

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
