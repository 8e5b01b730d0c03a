"""Functions on surrogates: create, preview, describe, list, change and delete them."""

from __future__ import annotations

import asyncio
import json
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from surrogym_server.engine.port import SessionEngine
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NoModel, SpecConflict, UnknownSurrogate
from surrogym_server.services.activity import Samplers
from surrogym_server.services.definitions import Define, Definitions
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import (
    ModelRecord,
    NewSurrogate,
    SurrogateRecord,
    SurrogateSummary,
)
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query

Plan = Callable[[EnvironmentDefinition, int], Sequence[Query]]
Complete = Callable[[dict[str, Any]], dict[str, Any]]

ABSENT = object()
READS = 3  # a surrogate's status is read at most this many times, as it is read again if a fit was stored meanwhile
SHOWN = 120  # a value of a specification is cut to this many characters in an error message


@dataclass(frozen=True)
class Listed:
    """Entry in the list of surrogates, with the active samplers and the number of open sessions."""

    summary: SurrogateSummary
    samplers: tuple[str, ...]  # names of the surrogate's samplers that called the server within about a minute
    sessions: int  # number of open sessions of the surrogate


@dataclass(frozen=True)
class SurrogateStatus(Listed):
    """A surrogate with its specification and its latest model."""

    record: SurrogateRecord
    outputs: tuple[str, ...]
    model: ModelRecord | None
    budget_left: int  # number of real steps that the design may still request before its budget is spent


@dataclass(frozen=True)
class Checked:
    """Preview of the registration of a surrogate. Nothing of it is stored."""

    initial: int  # number of real steps that the first queries of the design would take
    outputs: tuple[str, ...]
    exists: bool  # whether a surrogate of this name and specification exists already


class SurrogateService:
    def __init__(
        self,
        storage: Storage,
        definitions: Definitions,
        define: Define,
        complete: Complete,
        plan: Plan,
        engine: SessionEngine,
        notices: Notices,
        samplers: Samplers,
    ) -> None:
        """Keep the objects of the server that this service needs.

        Args:
            storage: stores the surrogates.
            definitions: definitions of the stored surrogates.
            define: returns the definition of a new specification; raises ``InvalidSpec`` if it needs a package that is
                not installed.
            complete: adds the fields that a specification (JSON) of an older program lacks.
            plan: returns the first queries of a design, given its budget.
            engine: runs the sessions of all surrogates.
            notices: notices of this process.
            samplers: active samplers that called this process.
        """
        self._storage = storage
        self._definitions = definitions
        self._define = define
        self._complete = complete
        self._plan = plan
        self._engine = engine
        self._notices = notices
        self._samplers = samplers

    def create(self, name: str, spec: dict[str, Any], budget: int, target: float) -> tuple[SurrogateStatus, bool]:
        """Create a surrogate with its initial queries. A repeat with the same name and specification changes nothing.

        Args:
            name: name of the surrogate.
            spec: specification as JSON.
            budget: largest number of real steps of the design.
            target: confidence index at which the design ends.

        Returns:
            The surrogate's status, and whether this call created it.

        Raises:
            SpecConflict: the name exists with another specification.
            InvalidSpec: the preset can't represent the specification.
        """
        queries = self._plan(self._define(spec), budget)
        present, created = self._storage.surrogates.create(NewSurrogate(name, spec, budget, target, queries))
        if not created:
            check_same(name, self._complete(present.spec), self._complete(spec))
        self._notices.post(name)
        return self.status(name), created

    def check(self, name: str, spec: dict[str, Any], budget: int) -> Checked:
        """Preview what ``create`` would store, without storing it. Raises the errors of ``create``."""
        definition = self._define(spec)
        initial = sum(query.steps for query in self._plan(definition, budget))
        try:
            present = self._storage.surrogates.get(name)
        except UnknownSurrogate:
            exists = False
        else:
            check_same(name, self._complete(present.spec), self._complete(spec))
            exists = True
        return Checked(initial, definition.outputs, exists)

    def status(self, name: str) -> SurrogateStatus:
        """Return the status of a surrogate. Raises ``UnknownSurrogate``."""
        return self._status(self._storage.surrogates.get(name))

    def spec(self, name: str) -> dict[str, Any]:
        """Return the stored specification of a surrogate. Raises ``UnknownSurrogate``."""
        return self._storage.surrogates.get(name).spec

    def list(self, after: int, limit: int) -> list[Listed]:
        """Return up to ``limit`` surrogates with an id above ``after``, oldest first."""
        alive, sessions = self._samplers.by_surrogate(), self._engine.counts().sessions
        return [
            Listed(summary, tuple(alive.get(summary.name, ())), sessions.get(summary.name, 0))
            for summary in self._storage.surrogates.summaries(after, limit)
        ]

    def change(
        self,
        name: str,
        *,
        paused: bool | None = None,
        budget: int | None = None,
        target: float | None = None,
        tolerances: dict[str, float | None] | None = None,
    ) -> SurrogateStatus:
        """Change the fields of a surrogate that are given (not None), and return its status.

        ``tolerances`` are by output, in the output's unit; None for an output removes its tolerance.

        Raises:
            UnknownSurrogate: there is no surrogate of this name.
            InvalidInput: ``tolerances`` has a name that is not an output.
        """
        outputs = self._definitions.get(name).outputs
        if unknown := sorted(set(tolerances or ()) - set(outputs)):
            raise InvalidInput(f"tolerances: expected names of outputs, which are {list(outputs)}, got {unknown[0]!r}")
        self._storage.surrogates.change(name, paused=paused, budget=budget, target=target, tolerances=tolerances)
        self._notices.post(name)
        return self.status(name)

    async def delete(self, name: str) -> None:
        """Delete a surrogate with its samples, models and sessions. Raises ``UnknownSurrogate``."""
        surrogate = await asyncio.to_thread(lambda: self._storage.surrogates.get(name).id)
        await asyncio.to_thread(self._storage.surrogates.delete, name)
        await self._engine.forget(surrogate)
        self._notices.post(name)

    def _status(self, record: SurrogateRecord) -> SurrogateStatus:
        summary, model, left = self._read(record.name)
        return SurrogateStatus(
            summary=summary,
            record=record,
            outputs=self._definitions.of(record).outputs,
            model=model,
            budget_left=left,
            samplers=tuple(self._samplers.by_surrogate().get(record.name, ())),
            sessions=self._engine.counts().sessions.get(record.name, 0),
        )

    def _read(self, name: str) -> tuple[SurrogateSummary, ModelRecord | None, int]:
        """Return a surrogate's summary, the record of its latest model, and the real steps that its budget has left.

        If a fit was stored between these three reads, the results may contradict each other. Then all are read again,
        at most ``READS`` times in total.
        """
        for _ in range(READS):
            left = self._storage.designs.left(name)
            # The summary must be read before the model. Otherwise the model could be older than the summary.
            summary = self._storage.surrogates.summary(name)
            try:
                model = self._storage.models.get(name)
            except NoModel:
                model = None
            same_model = summary.model_version == (None if model is None else model.version)
            if same_model and self._storage.designs.left(name) == left:
                break
        return summary, model, left


def check_same(name: str, had: Any, got: Any) -> None:
    """Raise ``SpecConflict`` if the stored specification ``had`` of the surrogate ``name`` differs from the new one,
    ``got``. The message names the first difference."""
    if had != got:
        where, old, new = difference(had, got)
        raise SpecConflict(
            f"surrogate {name!r} exists with another specification: {where} was created as {short(old)}, got "
            f"{short(new)}; register the new one under another name, or set budget and target by surrogym change"
        )


def difference(had: Any, got: Any, where: str = "") -> tuple[str, Any, Any]:
    """Return the path to the first difference between two JSON values, such as ``coordinates.0.name``, and both values
    at this path. ``where`` is the path to ``had`` and ``got`` themselves."""
    if isinstance(had, dict) and isinstance(got, dict):
        pairs = [(key, had.get(key, ABSENT), got.get(key, ABSENT)) for key in {**had, **got}]
    elif isinstance(had, list) and isinstance(got, list) and len(had) == len(got):
        pairs = [(str(i), *pair) for i, pair in enumerate(zip(had, got, strict=True))]
    else:
        return where, had, got
    key, old, new = next(pair for pair in pairs if pair[1] != pair[2])
    return difference(old, new, f"{where}.{key}" if where else key)


def short(value: Any) -> str:
    return "nothing" if value is ABSENT else textwrap.shorten(json.dumps(value), SHOWN, placeholder=" ...")
