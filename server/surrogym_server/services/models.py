"""Functions on the models of a surrogate: list, export and import models, and predict at given points."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.design_job import fidelity_of
from surrogym_server.engine.models import ModelCache
from surrogym_server.environment.actions import model_actions
from surrogym_server.errors import Damaged, InvalidInput, PluginFailed
from surrogym_server.models.files import from_bytes
from surrogym_server.models.guard import POINTS, plugin_calls, require_sound
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.judging import monte_carlo
from surrogym_server.sampling.uncertainty import UncertaintyResult, query_uncertainty
from surrogym_server.services.definitions import Definitions, check_coordinates, check_points
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import ModelRecord, NewModel, SurrogateRecord
from surrogym_server.storage.sql import Storage
from surrogym_server.virtual.imagined import Imagined, imagine
from surrogym_server.virtual.single_step import PointPrediction, predict_points

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True)
class Said(Generic[T]):
    """A result that a model computed, with the model's version and the names of its outputs."""

    version: int
    outputs: tuple[str, ...]
    result: T


def load_model(storage: Storage, definitions: Definitions, surrogate: int, version: int) -> DynamicsModel:
    """Load a stored model of the surrogate with the id ``surrogate``.

    Raises:
        UnknownModel, UnknownSurrogate: there is no such model or surrogate.
        NotInstalled: the package of the model's family is not installed.
        Damaged: the stored file has changed since it was written, or this program can't read it.
    """
    name = storage.surrogates.name_of(surrogate)
    definition, data = definitions.for_model(name), stored_model(storage, name, version)
    try:
        with plugin_calls(definition, interrupts=True):
            return from_bytes(definition, data)
    except InvalidInput as error:
        raise Damaged(f"model {version} of surrogate {name!r} can't be read: {error}") from error


def stored_tolerances(storage: Storage, surrogate: int, version: int) -> tuple[float, ...]:
    """Return the tolerances (O,) with which the confidence of a stored model was computed, in the outputs' units.

    ``surrogate`` is the id of the surrogate. Raises ``UnknownModel`` or ``UnknownSurrogate``.
    """
    return tuple(storage.models.get(storage.surrogates.name_of(surrogate), version).tolerances)


def stored_model(storage: Storage, name: str, version: int) -> bytes:
    """Return the safetensors file of a stored model.

    Raises:
        UnknownModel, UnknownSurrogate: there is no such model or surrogate.
        Damaged: the file has changed since it was stored. The model is set aside, the version before it is served, and
            a new fit becomes due.
    """
    try:
        return storage.models.blob(name, version)
    except Damaged as error:
        if storage.models.set_aside(name, version, str(error)):
            logger.error(
                "model %d of %s is set aside, the version before it is served, and a new fit is due: %s",
                version,
                name,
                error,
            )
        raise


class ModelService:
    def __init__(self, storage: Storage, definitions: Definitions, models: ModelCache, notices: Notices) -> None:
        self._storage = storage
        self._definitions = definitions
        self._models = models
        self._notices = notices

    def list(self, name: str) -> list[ModelRecord]:
        """Return the records of all models of a surrogate, oldest first."""
        self._storage.surrogates.get(name)
        return self._storage.models.list(name)

    def export(self, name: str, version: int) -> bytes:
        """Return a model as a safetensors file. Raises ``UnknownModel`` or ``Damaged``."""
        return stored_model(self._storage, name, version)

    def add(self, name: str, data: bytes) -> ModelRecord:
        """Import a safetensors file as the newest model of the surrogate ``name``, and return its record.

        Its confidence is computed with the tolerances of this surrogate.

        Raises:
            InvalidInput: the file is not a model of this surrogate.
            NotInstalled: the package of the model's family is not installed.
        """
        record = self._storage.surrogates.get(name)
        definition = self._definitions.for_model(name).with_tolerances(record.tolerances)
        try:
            with plugin_calls(definition, interrupts=True):
                new = _imported(from_bytes(definition, data), record, data)
        except PluginFailed as error:
            raise InvalidInput(str(error)) from error
        version = self._storage.models.add(name, new)
        self._models.publish(record.id, version)
        self._notices.post(name)
        return self._storage.models.get(name, version)

    def predict(self, name: str, q: Array, u: Array, version: int | None) -> Said[PointPrediction]:
        """Predict one step from each of the coordinates q (n, C) under the actions u (n, F), by the model's mean.

        ``version`` is that of the model, None for the newest.

        Raises:
            InvalidInput: an array has a wrong shape, or an action is out of bounds.
            NoModel, UnknownModel: there is no model, or none of this version.
            PluginFailed: the code of the model's family raised an error.
        """
        version, model = self._model(name, version)
        q, u = check_points(model.definition, q, u)
        with plugin_calls(model.definition, interrupts=True):
            return Said(version, model.definition.outputs, predict_points(model, q, u))

    def query_uncertainty(self, name: str, q: Array, u: Array, version: int | None) -> Said[UncertaintyResult]:
        """Return the model's uncertainty at coordinates q (n, C) under actions u (n, F). The input probability is
        computed from the latest occupancy (states that policies visited). Raises the errors of ``predict``."""
        version, model = self._model(name, version)
        q, u = check_points(model.definition, q, u)
        tolerances = np.array(self._storage.models.get(name, version).tolerances)
        occupancy = self._storage.occupancy.latest(name)
        states = None if occupancy is None else occupancy.states
        with plugin_calls(model.definition, interrupts=True):
            return Said(version, model.definition.outputs, query_uncertainty(model, q, u, tolerances, states))

    def imagine(self, name: str, q: Array, u: Array, *, draws: int, seed: int, version: int | None) -> Said[Imagined]:
        """Simulate episodes in the model from coordinates q (C,) under the actions u (T, F).

        Args:
            name: name of the surrogate.
            q: coordinates (C,) at the start.
            u: actions (T, F), one for each step.
            draws: number of episodes that follow samples of the posterior, in addition to one that follows the mean.
            seed: seed of the posterior samples.
            version: version of the model; None for the newest.

        Raises the errors of ``predict``.
        """
        version, model = self._model(name, version)
        start = check_coordinates(model.definition, "coordinates", q[None])[0]
        actions = model_actions(model.definition, u)
        with plugin_calls(model.definition, interrupts=True):
            return Said(version, model.definition.outputs, imagine(model, start, actions, draws=draws, seed=seed))

    def _model(self, name: str, version: int | None) -> tuple[int, DynamicsModel]:
        surrogate = self._storage.surrogates.get(name).id
        version = self._models.refresh(surrogate) if version is None else version
        return version, self._models.get(surrogate, version)


def _imported(model: DynamicsModel, record: SurrogateRecord, data: bytes) -> NewModel:
    q, u = monte_carlo(model.definition)
    require_sound(model, q[:POINTS], u[:POINTS])
    return NewModel(
        samples=model.samples,
        data_hash=model.digest,
        fidelity=fidelity_of(model, record.state.get("usual", ()), record.target),
        description=model.description,
        fit_seconds=0.0,
        blob=data,
    )
