"""Definitions of stored surrogates, and the checks of what is sent against them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.environment.actions import model_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NotInstalled, SurrogymError
from surrogym_server.models.registry import MODELS
from surrogym_server.sampling.acquisition import ACQUISITIONS
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import SurrogateRecord

Array = NDArray[np.float64]
Define = Callable[[dict[str, Any]], EnvironmentDefinition]


class Definitions:
    """Definition of each surrogate by name; made once.

    A surrogate may outlive the package that brought its family of models or its acquisition. What reads samples and
    states takes its definition by ``get`` and works without the package; what needs it asks here for more.
    """

    def __init__(self, storage: Storage, define: Define) -> None:
        self._storage = storage
        self._define = define
        self._made: dict[str, tuple[int, EnvironmentDefinition]] = {}
        self._lock = Lock()

    def get(self, name: str) -> EnvironmentDefinition:
        """Raises ``UnknownSurrogate``."""
        return self.of(self._storage.surrogates.get(name))

    def of(self, record: SurrogateRecord) -> EnvironmentDefinition:
        """The definition of a surrogate that was read."""
        with self._lock:
            id, definition = self._made.get(record.name, (None, None))
            if definition is None or id != record.id:
                definition = self._define(record.spec)
                self._made[record.name] = (record.id, definition)
            return definition

    def for_model(self, name: str) -> EnvironmentDefinition:
        """Where a model is to be read. Raises ``UnknownSurrogate``, or ``NotInstalled``: its family is not here."""
        definition = self.get(name)
        _require(name, MODELS.lack(definition.learning.model))
        return definition

    def for_design(self, name: str) -> EnvironmentDefinition:
        """Where a round is to be made. Raises as ``for_model``, and ``NotInstalled``: its acquisition is not here."""
        definition = self.for_model(name)
        _require(name, ACQUISITIONS.lack(definition.design.acquisition))
        return definition

    def lacking(self) -> list[str]:
        """One sentence for each stored surrogate that needs what is not here; one that can't be read is left out."""
        found = []
        for summary in self._storage.surrogates.summaries():
            try:
                self.for_design(summary.name)
            except NotInstalled as error:
                found.append(str(error))
            except SurrogymError:  # deleted meanwhile, or damaged, which who reads it is told
                continue
        return found


def _require(name: str, lack: str | None) -> None:
    if lack is not None:
        raise NotInstalled(f"surrogate {name} needs {lack}")


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
        raise InvalidInput(f"expected as many actions as coordinates, got {len(u)} actions and {len(q)} coordinates")
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
