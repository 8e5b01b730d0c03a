"""Surrogates: create, look at, change, delete."""

from __future__ import annotations

import asyncio
import json
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from surrogym_server.engine.port import SessionEngine
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NoModel, SpecConflict, UnknownSurrogate
from surrogym_server.services.activity import Samplers
from surrogym_server.services.definitions import Define, Definitions
from surrogym_server.services.notices import Notices
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import (
    ModelRecord,
    NewSurrogate,
    SurrogateRecord,
    SurrogateSummary,
)
from surrogym_shared.nouns import Query

Plan = Callable[[EnvironmentDefinition, int], tuple[Query, ...]]
Complete = Callable[[dict[str, Any]], dict[str, Any]]

ABSENT = object()
READS = 3  # most times that a status is read, while rounds are stored
SHOWN = 120  # largest number of characters of a value in an error


@dataclass(frozen=True)
class Listed:
    """Entry of a list: a surrogate, its samplers and its sessions."""

    summary: SurrogateSummary
    samplers: tuple[str, ...]  # heard of within the last minute
    sessions: int  # open


@dataclass(frozen=True)
class SurrogateStatus(Listed):
    """A surrogate with its specification and its latest model."""

    record: SurrogateRecord
    outputs: tuple[str, ...]
    model: ModelRecord | None
    budget_left: int  # real steps that may still be requested within the budget


@dataclass(frozen=True)
class Checked:
    """Preview of what a registration would store."""

    initial: int  # real steps of the initial queries
    outputs: tuple[str, ...]
    exists: bool  # with the same spec


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
        """
        Args:
            storage: stores the surrogates.
            definitions: definitions of the stored surrogates.
            define: returns the definition of a new specification; raises ``InvalidSpec`` if it needs a package that is
                not installed.
            complete: returns a specification with every field that this program knows, as JSON; one from an older
                program may lack some.
            plan: returns the first queries of a design, given its budget.
            engine: has the sessions of all surrogates.
            notices, samplers: those of this process.
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
        """Create a surrogate with its initial queries. The same name and specification again change nothing.

        Returns the surrogate's status, and whether this call created it.

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
        """Check what ``create`` would do, without doing it. Raises as ``create``."""
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
        """Return the stored specification. Raises ``UnknownSurrogate``."""
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
        """Change the fields that are not None. A tolerance of None removes the one that was set for its output.

        Raises:
            UnknownSurrogate: there is none of this name.
            InvalidInput: a tolerance for a name that is not an output.
        """
        outputs = self._definitions.get(name).outputs
        if unknown := sorted(set(tolerances or ()) - set(outputs)):
            raise InvalidInput(f"tolerances: unknown output {unknown[0]!r}, expected some of {list(outputs)}")
        self._storage.surrogates.change(name, paused=paused, budget=budget, target=target, tolerances=tolerances)
        self._notices.post(name)
        return self.status(name)

    async def delete(self, name: str) -> None:
        """Remove a surrogate with its samples, models and sessions; raises ``UnknownSurrogate``."""
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
        """Return the summary, the latest model, and the real steps that the budget has left, of the same moment.

        They are three reads. If a round was stored in between, all are repeated, a few times.
        """
        for _ in range(READS):
            left = self._storage.designs.left(name)
            summary = self._storage.surrogates.summary(name)  # before the model, which is then never older
            try:
                model = self._storage.models.get(name)
            except NoModel:
                model = None
            same_model = summary.model_version == (None if model is None else model.version)
            if same_model and self._storage.designs.left(name) == left:
                break
        return summary, model, left


def check_same(name: str, had: Any, got: Any) -> None:
    """Raise ``SpecConflict`` if the stored specification and the new one differ. The message names the first
    difference."""
    if had != got:
        where, old, new = difference(had, got)
        raise SpecConflict(
            f"{name!r} exists with another specification: {where} was created as {short(old)}, got "
            f"{short(new)}; register this one under another name; surrogym change sets that one's budget and target"
        )


def difference(had: Any, got: Any, where: str = "") -> tuple[str, Any, Any]:
    """Return the first place where two JSON values differ, such as ``coordinates.0.name``, and both values there."""
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
