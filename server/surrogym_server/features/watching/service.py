"""The service of streams: it checks the real steps that a machine posts, stores them, and returns them."""

from __future__ import annotations

from typing import Self

import numpy as np

from surrogym_server.convert import stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.environment.actions import model_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.feature import Core, Service
from surrogym_server.features.watching.store import Streams
from surrogym_server.services.definitions import check_coordinates
from surrogym_server.storage.records import JSON
from surrogym_server.storage.sql import Storage
from surrogym_shared.environments import is_same
from surrogym_shared.logs.rows import OFF_PERIOD, impossible
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.watching import AddSteps, MachineStep


class WatchingService(Service):
    """Stores the steps of streams."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._streams = storage.part(Streams)

    @classmethod
    def start(cls, core: Core) -> Self:
        return cls(core.storage)

    def add(self, name: str, body: AddSteps) -> tuple[int, int]:
        """Append steps to a stream, all or none. Return the number of steps that were not stored before, and the number
        of the step with which the stream has to continue.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
            InvalidInput: the steps are of another machine or period, have wrong shapes, lie out of bounds, or leave out
                steps of the stream.
            IdempotencyConflict: another step is stored under the same number.
        """
        spec = read_stored(EnvironmentSpec, "a stored specification", self._storage.surrogates.get(name).spec)
        _require_own(name, spec, body)
        definition = stored_definition(spec)
        steps = [_checked(definition, spec, index, step) for index, step in enumerate(body.steps)]
        return self._streams.add(name, body.stream, body.first, steps)

    def page(self, name: str, after: int, since: float, limit: int) -> list[JSON]:
        """Return up to ``limit`` steps with an id above ``after`` that were stored later than ``since`` (s since 1970),
        in order. Raises ``UnknownSurrogate``."""
        return self._streams.page(name, after, since, limit)


def _require_own(name: str, spec: EnvironmentSpec, body: AddSteps) -> None:
    """Raise ``InvalidInput`` if the steps are of another machine or sampling period than those of the
    specification."""
    if not is_same(body.machine, spec.environment):
        raise InvalidInput(
            f"machine: expected {spec.environment!r}, the environment of {name!r}, got {body.machine!r}: post the "
            "steps to the surrogate of that machine"
        )
    own, got = spec.sampling_period, body.period
    if own is not None and got is not None and abs(got / own - 1) > OFF_PERIOD:
        raise InvalidInput(
            f"period: expected {own:g} s between two steps, the sampling_period of the specification, "
            f"got {got:g} s: post steps of this period"
        )


def _checked(definition: EnvironmentDefinition, spec: EnvironmentSpec, index: int, step: MachineStep) -> JSON:
    """Return a step as it is stored. Raises ``InvalidInput``, which names the step by its index."""
    where = f"steps.{index}"
    check_coordinates(definition, f"{where}.coordinates", np.array([step.coordinates]))
    check_coordinates(definition, f"{where}.next_coordinates", np.array([step.next_coordinates]))
    if (fault := impossible(spec, step.coordinates) or impossible(spec, step.next_coordinates)) is not None:
        raise InvalidInput(f"{where}: {fault}; post values in the units of the specification")
    try:
        action = model_actions(definition, np.array([step.action]))
    except InvalidInput as error:
        raise InvalidInput(f"{where}: {str(error).removesuffix(' in row 0')}") from error
    return {**step.model_dump(mode="json"), "action": action[0].tolist()}
