"""The queue of queries for samplers: claim with a long poll, renew, fail, add by hand."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_server.errors import InvalidInput
from surrogym_server.services.activity import Samplers
from surrogym_server.services.definitions import Definitions, check_points, check_rollouts, check_settable
from surrogym_server.services.notices import Notices
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import LeasedQuery, Phase, Purpose, QueryRecord, QueryStatus

Array = NDArray[np.float64]

NO_STEPS = (np.zeros((0, 0)), np.zeros((0, 0)))
POLL_SECONDS = 2.0  # a notice of another server may be lost, so its queries are also found by polling
FINISHED: tuple[Phase, ...] = ("ready", "over_budget", "from_log", "failed")


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

    async def claim(
        self,
        name: str,
        sampler: str,
        limit: int,
        lease_seconds: float,
        wait_seconds: float,
        gone: Callable[[], Awaitable[bool]] | None = None,
    ) -> Claim:
        """Lease up to ``limit`` queries. If there are none, wait for some, or for the end of the design.

        ``gone`` says whether the sampler has disconnected meanwhile; then it gets no lease.

        Raises:
            UnknownSurrogate: there is no such surrogate, or it was deleted meanwhile.
        """
        deadline = time.monotonic() + wait_seconds
        with self._notices.listen(name) as listener:
            first = claim = await self._claim(name, sampler, limit, lease_seconds)
            while not (claim.queries or _finished_since(first, claim) or self._notices.closing):
                left = deadline - time.monotonic()
                if left <= 0:
                    break
                await listener.wait(min(left, POLL_SECONDS))
                if gone is not None and await gone():
                    break
                claim = await self._claim(name, sampler, limit, lease_seconds)
            return claim

    def renew(self, name: str, query_id: int, token: str, lease_seconds: float) -> None:
        """Renew a lease. Raises ``UnknownQuery``, ``ForeignLease`` or ``LeaseExpired``."""
        self._storage.queries.renew(name, query_id, token, lease_seconds)
        if sampler := self._storage.queries.get(name, query_id).sampler:
            self._samplers.heard(name, sampler)

    def fail(self, name: str, query_id: int, token: str, error: str, *, begun: bool) -> QueryRecord:
        """Return a query with an error, and whether a step of it may have been taken.

        Raises:
            UnknownQuery, ForeignLease, LeaseExpired: as the storage says.
        """
        record = self._storage.queries.fail(name, query_id, token, error, begun=begun)
        self._notices.post(name)
        return record

    def add(
        self,
        name: str,
        coordinates: Array,
        action: Array,
        key: str | None,
        rollouts: Sequence[Array] = (),
        *,
        purpose: Purpose = "manual",
    ) -> list[QueryRecord]:
        """Queue queries by hand, or of an audit: coordinates (m, C) and action (m, F), or action sequences (T, F).

        Raises:
            InvalidInput: wrong shape, out of bounds, or a kind that the original environment can't answer.
            IdempotencyConflict: the same key with other queries.
            BeyondBudget: all audits together would take more real steps than the design may.
        """
        definition = self._definitions.get(name)
        if definition.max_rollout is None:
            if len(rollouts) or not len(coordinates):
                raise InvalidInput(
                    "expected coordinates and actions, no rollouts: the original environment can be set to any state"
                )
            q, u = check_points(definition, check_settable(definition, coordinates), action)
            ids = self._storage.queries.enqueue(name, q, u, purpose=purpose, key=key)
        else:
            if len(coordinates) or len(action) or not len(rollouts):
                raise InvalidInput(
                    "expected rollouts, no coordinates: the original environment can't be set to a state"
                )
            ids = self._storage.queries.enqueue(
                name, *NO_STEPS, check_rollouts(definition, rollouts), purpose=purpose, key=key
            )
        self._notices.post(name)
        return [self._storage.queries.get(name, id) for id in ids]

    def withdraw_audit(self, name: str, query_ids: Sequence[int]) -> int:
        """Remove those of the given queries that belong to an audit and that no sampler has begun. Returns their
        number."""
        pending = self._storage.queries.list(name, ("pending",))
        audits = [query.id for query in pending if query.purpose == "audit" and query.id in set(query_ids)]
        withdrawn = self._storage.queries.withdraw(name, audits) if audits else 0
        if withdrawn:
            self._notices.post(name)
        return withdrawn

    def list(self, name: str, statuses: Sequence[QueryStatus]) -> list[QueryRecord]:
        """The queries of these statuses (none: all), oldest first."""
        return self._storage.queries.list(name, statuses)

    async def _claim(self, name: str, sampler: str, limit: int, lease_seconds: float) -> Claim:
        def claim() -> Claim:
            queries = self._storage.queries.claim(name, sampler, limit, lease_seconds)
            standing = self._storage.surrogates.standing(name)
            self._samplers.heard(name, sampler)
            return Claim(queries, standing.phase, standing.paused)

        return await asyncio.to_thread(claim)


def _finished_since(first: Claim, now: Claim) -> bool:
    return now.phase != first.phase and now.phase in FINISHED
