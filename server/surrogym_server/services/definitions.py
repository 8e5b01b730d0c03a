"""Environment definitions of stored surrogates, and checks of requests against a definition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.environment.actions import model_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NotInstalled, SurrogymError
from surrogym_server.models.registry import MODELS
from surrogym_server.sampling.acquisition import ACQUISITIONS
from surrogym_server.storage.records import SurrogateRecord
from surrogym_shared.network import Network
from surrogym_shared.nouns import Query
from surrogym_shared.spec import MAX_ROLLOUT_QUERY

if TYPE_CHECKING:  # checks of points need no database
    from surrogym_server.storage.sql import Storage

Array = NDArray[np.float64]
Define = Callable[[dict[str, Any]], EnvironmentDefinition]


class Definitions:
    """Cache of the environment definitions of stored surrogates, by name. Each is built when it is first needed.

    The package that provides a surrogate's model family or acquisition may have been uninstalled. ``get`` works
    without the package and is enough to read samples and states. ``for_model`` and ``for_design`` check that it is
    installed.
    """

    def __init__(self, storage: Storage, define: Define) -> None:
        self._storage = storage
        self._define = define
        self._cache: dict[str, tuple[int, EnvironmentDefinition]] = {}
        self._lock = Lock()

    def get(self, name: str) -> EnvironmentDefinition:
        """Return the environment definition of the surrogate ``name``. Raises ``UnknownSurrogate``."""
        entry = self._cache.get(name)
        if entry is not None and entry[0] == self._storage.surrogates.standing(name).id:
            return entry[1]
        return self.of(self._storage.surrogates.get(name))

    def of(self, record: SurrogateRecord) -> EnvironmentDefinition:
        """Return the definition of the surrogate that a record describes, without reading the record again."""
        with self._lock:
            id, definition = self._cache.get(record.name, (None, None))
            if definition is None or id != record.id:
                definition = self._define(record.spec)
                self._cache[record.name] = (record.id, definition)
            return definition

    def for_model(self, name: str) -> EnvironmentDefinition:
        """Return the environment definition of a surrogate, for a caller that will load a model.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
            NotInstalled: the package of the surrogate's model family is not installed.
        """
        definition = self.get(name)
        _require(name, MODELS.lack(definition.learning.model))
        return definition

    def for_design(self, name: str) -> EnvironmentDefinition:
        """Return the environment definition of a surrogate, for a caller that will fit a model and choose queries.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
            NotInstalled: the package of the surrogate's model family or acquisition is not installed.
        """
        definition = self.for_model(name)
        _require(name, ACQUISITIONS.lack(definition.design.acquisition))
        return definition

    def lacking(self) -> list[str]:
        """Return a sentence for each stored surrogate that needs a package which is not installed.

        Surrogates whose specification can't be read are left out.
        """
        sentences = []
        for summary in self._storage.surrogates.summaries():
            try:
                self.for_design(summary.name)
            except NotInstalled as error:
                sentences.append(str(error))
            except SurrogymError:  # left out: the surrogate was just deleted, or its specification can't be read
                continue
        return sentences


def _require(name: str, lack: str | None) -> None:
    if lack is not None:
        raise NotInstalled(f"surrogate {name} needs {lack}")


def check_coordinates(definition: EnvironmentDefinition, what: str, rows: Array) -> Array:
    """Return ``rows`` unchanged if their shape is (n, C), that of n states with C coordinates; otherwise raise
    ``InvalidInput``. ``what`` is the array's name in the message."""
    names = definition.coordinate_names
    if rows.ndim != 2 or rows.shape[1] != len(names):
        raise InvalidInput(
            f"{what}: expected shape (n, {len(names)}), one column for each of {list(names)}, got {rows.shape}"
        )
    return rows


def check_points(definition: EnvironmentDefinition, q: Array, u: Array) -> tuple[Array, Array]:
    """Check coordinates q (n, C) and actions u (n, F) of n steps. Return the coordinates, and the actions in the form
    in which the model takes them.

    Raises:
        InvalidInput: an array has a wrong shape, the numbers of states and actions differ, or an action is out of
            bounds.
    """
    q = check_coordinates(definition, "coordinates", q)
    if len(q) != len(u):
        raise InvalidInput(
            f"expected one action for each row of coordinates, got {len(u)} actions and {len(q)} rows of coordinates"
        )
    return q, model_actions(definition, u)


def check_steps(definition: EnvironmentDefinition, queries: Sequence[Query]) -> list[Query]:
    """Check queries (requested real steps) that are single steps, and return them, with actions as float64.

    Raises:
        InvalidInput: coordinates or actions have a wrong shape, the original environment can't be set to a state, or
            an action is out of bounds.
    """
    q = check_settable(definition, np.array([query.coordinates for query in queries]))
    u = model_actions(definition, np.array([query.action for query in queries]))
    return [Query.step(*step) for step in zip(q.tolist(), u.tolist(), strict=True)]


def check_rollouts(definition: EnvironmentDefinition, queries: Sequence[Query]) -> list[Query]:
    """Check queries (requested real steps) that are rollouts, sequences of actions, and return them, with actions as
    float64.

    Raises:
        InvalidInput: a rollout is too long, actions have a wrong shape or are out of bounds, or a policy does not fit
            the environment.
    """
    for query in queries:
        if query.policy is not None:
            try:
                Network.load(query.policy).require_fit(len(definition.observation), definition.action)
            except ValueError as error:
                raise InvalidInput(f"policy: {error}") from error
        acted = query.replan or query.policy is not None
        longest = (definition.time_limit or MAX_ROLLOUT_QUERY) if acted else definition.max_rollout or 0
        if query.steps > longest:
            raise InvalidInput(
                f"rollouts: expected at most {longest} actions in a rollout, got {query.steps}: split the rollout"
            )
    actions = (model_actions(definition, np.array(query.actions)) for query in queries)
    return [
        Query.rollout(u.tolist(), query.snapshot, replan=query.replan, policy=query.policy)
        for u, query in zip(actions, queries, strict=True)
    ]


def check_trial(definition: EnvironmentDefinition, trial: Query) -> Query:
    """Check the query of a trial, an episode in which a policy acts, and return it, with actions as float64.

    Raises:
        InvalidInput: the original environment can be set to any state, the trial is too long, or actions or the policy
            do not fit the environment.
    """
    if definition.max_rollout is None:
        raise InvalidInput(
            "trial: expected an original environment that can only be reset, got one that can be set to any state: "
            "request queries"
        )
    return check_rollouts(definition, [trial])[0]


def check_settable(definition: EnvironmentDefinition, q: Array) -> Array:
    """Check that the original environment can be set to each of n states q (n, C), and return q.

    Raises:
        InvalidInput: q has a wrong shape, or a value is beyond its coordinate's bound, or beyond the sampling range on
            a side without a bound.
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
