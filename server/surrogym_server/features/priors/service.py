"""The service of a surrogate's prior (a model known beforehand): check and store it, wait for it, remove it."""

from __future__ import annotations

from typing import Any, Self

from pydantic import ValidationError

from surrogym_server.convert import stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, PluginFailed
from surrogym_server.feature import Core, Service
from surrogym_server.models.abilities import TakesPrior
from surrogym_server.models.files import from_bytes
from surrogym_server.models.guard import POINTS, plugin_calls, require_sound
from surrogym_server.models.registry import learner_of
from surrogym_server.sampling.judging import monte_carlo
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import difference, short
from surrogym_server.storage.records import PriorRecord
from surrogym_server.storage.sql import Storage
from surrogym_shared.faults import first_fault
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import NotASurrogateFile, SurrogateFile
from surrogym_shared.wire.priors import PriorAbout

SHARED = ("name", "kind", "unit", "lag")  # fields of a coordinate that a prior and the surrogate must have in common


class PriorService(Service):
    """Checks and stores priors. The next fit of a design uses its prior."""

    def __init__(self, storage: Storage, notices: Notices) -> None:
        self._storage = storage
        self._notices = notices

    @classmethod
    def start(cls, core: Core) -> Self:
        return cls(core.storage, core.notices)

    def get(self, name: str) -> PriorRecord | None:
        """Return the description of a surrogate's prior; None if it has none. Raises ``UnknownSurrogate``."""
        return self._storage.priors.get(name)

    def put(self, name: str, data: bytes) -> None:
        """Store the model in a file of ``surrogym export`` (``data``) as the prior, which replaces an earlier one.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
            InvalidInput: ``data`` is no such file, its coordinates or actions differ from those of this surrogate, its
                model can't be used, or the surrogate's model family can't use a prior.
        """
        spec = read_stored(EnvironmentSpec, "a stored specification", self._storage.surrogates.get(name).spec)
        definition = stored_definition(spec)
        self._require_family(definition)
        try:
            file = SurrogateFile.from_bytes(data)
            about = PriorAbout.model_validate_json(file.about_as_json()).model_dump(mode="json")
        except NotASurrogateFile as error:
            raise InvalidInput(str(error)) from error
        except ValidationError as error:
            raise InvalidInput(
                f"the description of the prior in this file is invalid: {first_fault(error)}; export the prior again"
            ) from error
        _require_alike(spec, file.spec)
        try:
            with plugin_calls(definition, interrupts=True):
                q, u = monte_carlo(definition)
                require_sound(from_bytes(definition, file.model), q[:POINTS], u[:POINTS])
        except PluginFailed as error:
            raise InvalidInput(str(error)) from error
        self._storage.priors.put(name, file.model, about)
        self._notices.post(name)

    def wait(self, name: str) -> None:
        """Let the design of a surrogate wait for a prior.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
            InvalidInput: the surrogate's model family can't use a prior.
        """
        spec = read_stored(EnvironmentSpec, "a stored specification", self._storage.surrogates.get(name).spec)
        self._require_family(stored_definition(spec))
        self._storage.priors.wait(name)
        self._notices.post(name)

    def drop(self, name: str) -> None:
        """Remove a surrogate's prior, or stop waiting for one. Raises ``UnknownSurrogate``."""
        self._storage.priors.drop(name)
        self._notices.post(name)

    @staticmethod
    def _require_family(definition: EnvironmentDefinition) -> None:
        family = definition.learning.model
        if not isinstance(learner_of(family), TakesPrior):
            raise InvalidInput(
                "expected a surrogate with a family of models that can use a prior, such as gaussian_process, got "
                f"{family.name!r}: register another surrogate"
            )


def _require_alike(spec: EnvironmentSpec, other: EnvironmentSpec) -> None:
    """Raise ``InvalidInput`` if the specification of a prior (``other``) has other coordinates or actions than the
    surrogate's."""
    own, got = _shared_fields(spec), _shared_fields(other)
    if own != got:
        where, expected, came = difference(own, got)
        raise InvalidInput(
            f"expected a prior with the coordinates, units and actions of the surrogate, got {where} as {short(came)} "
            f"where the surrogate has {short(expected)}"
        )


def _shared_fields(spec: EnvironmentSpec) -> dict[str, Any]:
    coordinates = [one.model_dump(mode="json", include=set(SHARED)) for one in spec.coordinates]
    return {"coordinates": coordinates, "action": spec.action.model_dump(mode="json")}
