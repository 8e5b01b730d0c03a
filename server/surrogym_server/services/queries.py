"""The queue of queries (requested real steps). Samplers claim queries from it, renew their leases and report failures;
people and audits add queries."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

from surrogym_server.errors import InvalidInput
from surrogym_server.services.activity import Samplers
from surrogym_server.services.claim_queues import ClaimQueues, Present
from surrogym_server.services.definitions import Definitions, check_rollouts, check_steps
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import LeasedQuery, QueryRecord
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query
from surrogym_shared.states import ENDED, Phase, Purpose


@dataclass(frozen=True)
class Claim:
    queries: list[LeasedQuery]
    phase: Phase
    paused: bool


class QueryService:
    def __init__(
        self, storage: Storage, definitions: Definitions, notices: Notices, samplers: Samplers | None = None
    ) -> None:
        self._storage = storage
        self._definitions = definitions
        self._notices = notices
        self._samplers = samplers or Samplers()
        self._queues = ClaimQueues[Claim](notices, has_work=lambda claim: bool(claim.queries), ends=_finished_since)

    async def claim(
        self,
        name: str,
        sampler: str,
        limit: int,
        lease_seconds: float,
        wait_seconds: float,
        present: Present | None = None,
    ) -> Claim:
        """Lease up to ``limit`` queries to a sampler.

        If no query is open, wait up to ``wait_seconds`` until one is, or until the design ends.

        Args:
            name: name of the surrogate.
            sampler: name of the sampler.
            limit: largest number of queries; 0 if the sampler ends.
            lease_seconds: duration of the leases.
            wait_seconds: longest wait.
            present: raises if the sampler has closed its connection, which then gets no lease.

        Raises:
            UnknownSurrogate: the surrogate does not exist, or was deleted during the wait.
        """

        def claim() -> Claim:
            queries = self._storage.queries.claim(name, sampler, limit, lease_seconds)
            standing = self._storage.surrogates.standing(name)
            return Claim(queries, standing.phase, standing.paused)

        if not limit:
            standing = await asyncio.to_thread(self._storage.surrogates.standing, name)
            self._samplers.forget(name, sampler)
            return Claim([], standing.phase, standing.paused)
        self._samplers.heard(name, sampler)
        leases = await self._queues.claim(name, None, claim, wait_seconds, present)
        if leases.queries:  # else the sampler may have ended meanwhile
            self._samplers.heard(name, sampler)
        return leases

    def renew(self, name: str, query_id: int, token: str, lease_seconds: float) -> None:
        """Extend the lease of a query to ``lease_seconds`` from now.

        Raises ``UnknownQuery``, ``ForeignLease`` or ``LeaseExpired``.
        """
        self._storage.queries.renew(name, query_id, token, lease_seconds)
        if sampler := self._storage.queries.get(name, query_id).sampler:
            self._samplers.heard(name, sampler)

    def fail(
        self, name: str, query_id: int, token: str, error: str, *, begun: bool, refused: bool = False
    ) -> QueryRecord:
        """End the lease of a query that a sampler could not answer, with the sampler's ``error``.

        ``begun`` is True if a real step may have been taken, and ``refused`` is True if the original environment
        refused the query.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: the token is not that of a lease of this query.
            LeaseExpired: the lease has ended.
        """
        record = self._storage.queries.fail(name, query_id, token, error, begun=begun, refused=refused)
        self._notices.post(name)
        return record

    def add(
        self, name: str, queries: Sequence[Query], key: str | None, *, purpose: Purpose = "manual"
    ) -> list[QueryRecord]:
        """Queue queries that a person or an audit (``purpose``) chose, and return their records.

        ``key`` is the idempotency key: a repeat with the same key adds nothing.

        Raises:
            InvalidInput: an array has a wrong shape, a value is out of bounds, or the original environment can't answer
                this kind of query.
            IdempotencyConflict: the same key came with other queries.
            BeyondBudget: all audits of the surrogate together would take more real steps than its budget, and more than
                128.
        """
        definition = self._definitions.get(name)
        kinds = {query.kind for query in queries}
        if definition.max_rollout is None:
            if kinds != {"step"}:
                raise InvalidInput(
                    "expected coordinates and actions of single steps, got rollouts: the original environment can be "
                    "set to any state, so send single steps"
                )
            queries = check_steps(definition, queries)
        else:
            if kinds != {"rollout"}:
                raise InvalidInput(
                    "expected rollouts, got coordinates: the original environment can't be set to a state, so send "
                    "actions from a reset or snapshot"
                )
            queries = check_rollouts(definition, queries)
        ids = self._storage.queries.enqueue(name, queries, purpose=purpose, key=key)
        self._notices.post(name)
        return [self._storage.queries.get(name, id) for id in ids]

    def withdraw_audit(self, name: str, query_ids: Sequence[int]) -> int:
        """Remove queries of an audit, or trials, given by their ids. A query stays if a sampler may have taken a real
        step of it.

        Returns the number of removed queries.
        """
        pending = self._storage.queries.list(name, ("pending",))
        asked = [query for query in pending if query.purpose == "audit" or query.policy is not None]
        ids = [query.id for query in asked if query.id in set(query_ids)]
        withdrawn = self._storage.queries.withdraw(name, ids) if ids else 0
        if withdrawn:
            self._notices.post(name)
        return withdrawn


def _finished_since(first: Claim, now: Claim) -> bool:
    return now.phase != first.phase and now.phase in ENDED
