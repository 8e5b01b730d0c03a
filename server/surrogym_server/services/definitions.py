"""Definitions of stored surrogates, and the checks of what is sent against them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.environment.actions import model_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.storage.port import Storage

Array = NDArray[np.float64]
Define = Callable[[dict[str, Any]], EnvironmentDefinition]


class Definitions:
    """Definition of each surrogate by name; made once."""

    def __init__(self, storage: Storage, define: Define) -> None:
        self._storage = storage
        self._define = define
        self._made: dict[str, tuple[int, EnvironmentDefinition]] = {}
        self._lock = Lock()

    def get(self, name: str) -> EnvironmentDefinition:
        """Raises ``UnknownSurrogate``."""
        record = self._storage.surrogates.get(name)
        with self._lock:
            id, definition = self._made.get(name, (None, None))
            if definition is None or id != record.id:
                definition = self._define(record.spec)
                self._made[name] = (record.id, definition)
            return definition


def check_coordinates(definition: EnvironmentDefinition, what: str, rows: Array) -> Array:
    """Coordinates (n, C) as they are. Raises ``InvalidInput`` unless they have C entries."""
    names = definition.coordinate_names
    if rows.ndim != 2 or rows.shape[1] != len(names):
        raise InvalidInput(f"{what}: expected (n, {len(names)}), one entry for each of {list(names)}, got {rows.shape}")
    return rows


def check_points(definition: EnvironmentDefinition, q: Array, u: Array) -> tuple[Array, Array]:
    """Points (n, C) and their actions (n, F) in the model's units.

    Raises:
        InvalidInput: another shape, another number of points than of actions, or an action out of bounds.
    """
    q = check_coordinates(definition, "coordinates", q)
    if len(q) != len(u):
        raise InvalidInput(f"expected as many actions as coordinates, got {len(u)} and {len(q)}")
    return q, model_actions(definition.action, u)


def check_rollouts(definition: EnvironmentDefinition, rollouts: Sequence[Array]) -> list[Array]:
    """Action sequences, each (T, F), in the model's units.

    Raises:
        InvalidInput: one that is too long, of another shape, or out of bounds.
    """
    longest = definition.max_rollout or 0
    for actions in rollouts:
        if len(actions) > longest:
            raise InvalidInput(f"rollouts: expected at most {longest} actions, got {len(actions)}")
    return [model_actions(definition.action, actions) for actions in rollouts]


def check_settable(definition: EnvironmentDefinition, q: Array) -> Array:
    """Coordinates (n, C) that the original environment can be set to.

    Raises:
        InvalidInput: another shape, or beyond a bound of the environment or, on a side without one, beyond the
            sampling range: a sampler sets its environment to nothing else.
    """
    q = check_coordinates(definition, "coordinates", q)
    for index, coordinate in enumerate(definition.coordinates):
        low, high = coordinate.settable
        beyond = (q[:, index] < low) | (q[:, index] > high)
        if beyond.any():
            raise InvalidInput(
                f"coordinate {coordinate.name!r}: expected a value in [{low:g}, {high:g}], got {q[beyond, index][0]:g}"
            )
    return q
