"""Functions on the samples (results of real steps) of a surrogate: add and read samples, and count real steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from surrogym_server.environment.actions import at_bound, model_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.sampling.coverage import covered
from surrogym_server.services.activity import Samplers
from surrogym_server.services.definitions import Definitions, check_coordinates
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import (
    AddedSamples,
    LedgerRecord,
    LogPart,
    NewSample,
    SampleRecord,
    SurrogateRecord,
)
from surrogym_server.storage.sql import Storage
from surrogym_shared.limits import KeptSteps
from surrogym_shared.spec import EnvironmentSpec

PAGE = 10_000
BATCH = 500  # steps of a log are stored in batches of this size, each in one database transaction
MOST_KEPT = 1_000  # largest number of surrogates of which it is kept how well the steps kept limits
LOG = "log"  # steps of a log are stored with this name in place of a sampler's name


class Added(NamedTuple):
    """Result of adding samples, and the counts of real steps after it."""

    stored: AddedSamples
    ledger: LedgerRecord


@dataclass(frozen=True)
class AddedLog:
    stored: int  # number of steps of the log that this call has stored, because they were not stored before
    duplicates: int


NOTHING = AddedLog(0, 0)


class SampleService:
    def __init__(
        self, storage: Storage, definitions: Definitions, notices: Notices, samplers: Samplers | None = None
    ) -> None:
        self._storage = storage
        self._definitions = definitions
        self._notices = notices
        self._samplers = samplers or Samplers()
        self._kept: dict[int, tuple[int, KeptSteps]] = {}  # id of the newest counted sample, by id of the surrogate

    def add(
        self,
        name: str,
        sampler: str,
        samples: Sequence[NewSample],
        key: str | None,
        log: LogPart | None = None,
    ) -> Added:
        """Store real steps, either all or, if an error is raised, none. They are in the database when the call returns.

        Args:
            name: name of the surrogate.
            sampler: name of the sampler.
            samples: the real steps, with the lease of their query if they answer one.
            key: idempotency key; needed for steps that answer no query and belong to no log.
            log: position of the steps in a log of earlier steps; None if they come from no log. After the last part of
                a log, the initial queries that it makes unnecessary are withdrawn.

        Raises:
            InvalidInput: an array has a wrong shape, an action is out of bounds, or the key is missing. The message
                names the sample by its index.
            UnknownQuery: the surrogate has no query with the id in a sample.
            ForeignLease: the token is not that of a lease of this query.
            IdempotencyConflict: the same key came with other samples.
        """
        definition = self._definitions.get(name)
        checked = [_checked(definition, index, sample) for index, sample in enumerate(samples)]
        check_trajectories(checked)
        if key is None and log is None and any(sample.query_id is None for sample in checked):
            raise InvalidInput(
                "idempotency_key: expected one, because some samples have no query_id, got none: add a text of your "
                "own that names this request"
            )
        bound = at_bound(definition, [sample.action for sample in checked])
        added = self._storage.samples.add(name, sampler, checked, key=key, log=log, at_bound=bound)
        if log is not None and log.complete and added.restart is None:
            self._withdraw_covered(name, definition)
        self._samplers.heard(name, sampler)
        self._notices.post(name)
        return Added(added, self._storage.ledger.read(name))

    def add_log(self, name: str, samples: Sequence[NewSample], origin: str | None = None) -> AddedLog:
        """Store all steps of a log, in batches. A repeat stores only steps that are not stored yet, for example after
        an interruption.

        ``origin`` names the source of the log: logs of different origins are stored apart even if their numbers are
        equal. Raises the errors of ``add``.
        """
        first, duplicates, after = 0, 0, origin
        while first < len(samples):
            batch = samples[first : first + BATCH]
            added = self.add(name, LOG, batch, None, LogPart(after, complete=first + BATCH >= len(samples))).stored
            if added.restart is not None:
                first, duplicates, after = 0, 0, added.restart
            else:
                first, duplicates, after = first + BATCH, duplicates + added.duplicates, added.digest
        return AddedLog(len(samples) - duplicates, duplicates)

    def _withdraw_covered(self, name: str, definition: EnvironmentDefinition) -> None:
        pending = [query for query in self._storage.queries.list(name, ("pending",)) if query.purpose == "initial"]
        if not pending:
            return
        real_steps = self._storage.samples.arrays(name)
        logged = np.array([purpose == "logged" for purpose in real_steps.purpose], dtype=np.bool_)
        q, u = real_steps.coordinates[logged], real_steps.action[logged]
        if definition.max_rollout is not None:
            steps = np.cumsum([query.steps for query in pending])
            chosen = steps <= len(q)
        else:
            columns = [np.array([getattr(query, field) for query in pending]) for field in ("coordinates", "action")]
            chosen = covered(definition, columns[0], columns[1], q, u)
        covering = [query.id for query, one in zip(pending, chosen, strict=True) if one]
        if covering:
            self._storage.queries.withdraw(name, covering)

    def page(self, name: str, after: int, limit: int) -> list[SampleRecord]:
        """Return up to ``limit`` samples with an id above ``after``, in order. Raises ``UnknownSurrogate``."""
        return self._storage.samples.page(name, after, limit)

    def drop_snapshots(self, name: str, snapshots: Sequence[str]) -> int:
        """Remove snapshots that no sampler holds any more, and return the number removed. Queries that begin at a
        removed snapshot are replaced by new queries."""
        count = self._storage.snapshots.drop(name, snapshots)
        self._notices.post(name)
        return count

    def all(self, name: str) -> list[SampleRecord]:
        """Return all samples of a surrogate, in order of arrival."""
        records = page = self.page(name, 0, PAGE)
        while len(page) == PAGE:
            page = self.page(name, page[-1].id, PAGE)
            records = records + page
        return records

    def kept(self, record: SurrogateRecord, spec: EnvironmentSpec) -> KeptSteps:
        """Return how well all real steps of a surrogate kept the limits of its specification. Only the samples since
        the last call are read, because samples are never changed, and only deleted with their surrogate."""
        newest, kept = self._kept.get(record.id, (0, KeptSteps()))
        while page := self.page(record.name, newest, PAGE):
            newest, kept = page[-1].id, kept.with_steps(spec, page)
        if len(self._kept) > MOST_KEPT:
            self._kept = {}
        self._kept[record.id] = newest, kept
        return kept

    def coordinate_names(self, name: str) -> tuple[str, ...]:
        """Return the names of a surrogate's coordinates, in their order in a sample."""
        return self._definitions.get(name).coordinate_names


def check_trajectories(samples: Sequence[NewSample]) -> None:
    """Check that each step of a rollout begins at the state in which its previous step ended, and that no step follows
    the end of an episode.

    Raises:
        InvalidInput: a step begins at another state or follows the end of an episode; the message names the sample by
            its index.
    """
    steps = {(s.query_id, s.lease_token, s.step): s for s in samples}
    for index, sample in enumerate(samples):
        before = steps.get((sample.query_id, sample.lease_token, sample.step - 1))
        if before is None or sample.query_id is None:
            continue
        if before.terminated or before.truncated:
            raise InvalidInput(
                f"samples.{index}: expected no step after the end of the episode in step {before.step}, got step "
                f"{sample.step}: leave it out"
            )
        if before.next_coordinates != sample.coordinates:
            raise InvalidInput(
                f"samples.{index}.coordinates: expected {list(before.next_coordinates)}, where step {before.step} of "
                f"the same query ended, got {list(sample.coordinates)}"
            )


def _checked(definition: EnvironmentDefinition, index: int, sample: NewSample) -> NewSample:
    where = f"samples.{index}"
    if (sample.query_id is None) != (sample.lease_token is None):
        raise InvalidInput(
            f"{where}: expected both query_id and lease_token, or neither, got one of them: send both, as the reply to "
            "the claim of the query has them"
        )
    check_coordinates(definition, f"{where}.coordinates", np.array([sample.coordinates]))
    check_coordinates(definition, f"{where}.next_coordinates", np.array([sample.next_coordinates]))
    for what in ("observation", "next_observation"):
        _check_observation(definition, f"{where}.{what}", getattr(sample, what))
    try:
        action = model_actions(definition, np.array([sample.action]))
    except InvalidInput as error:
        raise InvalidInput(f"{where}: {str(error).removesuffix(' in row 0')}") from error
    return replace(sample, action=tuple(action[0].tolist()))


def _check_observation(definition: EnvironmentDefinition, where: str, observation: tuple[float, ...] | None) -> None:
    size = len(definition.observation_names)
    if observation is not None and len(observation) != size:
        raise InvalidInput(f"{where}: expected {size} numbers, one for each observation entry, got {len(observation)}")
