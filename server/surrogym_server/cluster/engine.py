"""RayEngine: sessions in a fixed pool of session hosts. This process holds nothing of them."""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter
from collections.abc import Awaitable, Sequence
from typing import Any, cast
from zlib import crc32

import ray
from ray.exceptions import RayActorError, RayError

from surrogym_server.cluster.host import Refused
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, Array, Open, Reply, Restore, Saved, SessionInfo, Visited
from surrogym_server.engine.tallies import Counts, Durations, SessionActivity
from surrogym_server.errors import Unavailable

COUNTING_SECONDS = 10.0


class RayEngine(SessionEngine):
    """Asks the host that has a session. The id of a session ends with the number of its host, so any front server
    finds it; an opening under an idempotency key always goes to the same host.

    Args:
        hosts: actor handles of ``SessionHost``, by number.
        idle_seconds: as the hosts have it.
    """

    lasting = True

    def __init__(self, hosts: Sequence[Any], idle_seconds: float) -> None:
        self.idle_seconds = idle_seconds
        self._hosts = tuple(hosts)
        self._turns = itertools.count()

    async def open(self, request: Open) -> SessionInfo:
        key = request.opening.key
        turn = next(self._turns) if key is None else crc32(f"{request.surrogate}|{key}".encode())
        return cast(SessionInfo, await self._ask(turn % len(self._hosts), "open", request))

    async def advance(self, request: Advance) -> Reply:
        return cast(Reply, await self._ask(self._host_of(request.session), "advance", request))

    async def describe(self, session: str) -> SessionInfo:
        return cast(SessionInfo, await self._ask(self._host_of(session), "describe", session))

    async def coordinates(self, session: str) -> Array:
        return cast(Array, await self._ask(self._host_of(session), "coordinates", session))

    async def submit(self, session: str) -> Visited:
        return cast(Visited, await self._ask(self._host_of(session), "submit", session))

    async def close(self, session: str) -> None:
        await self._ask(self._host_of(session), "close", session)

    async def forget(self, surrogate: int) -> None:
        await self._ask_all("forget", surrogate)

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        return [one for of_host in await self._ask_all("activity", surrogate) for one in of_host]

    def counts(self) -> Counts:
        try:
            found: list[Counts] = ray.get([host.counts.remote() for host in self._hosts], timeout=COUNTING_SECONDS)
        except RayError as error:
            raise Unavailable("a session host does not answer now: try again later") from error
        return _together(found)

    async def sweep(self) -> None:
        await self._ask_all("sweep")

    async def start(self) -> None:
        """The hosts have started."""

    async def stop(self) -> None:
        """The hosts go on: their sessions belong to every front server."""

    async def save(self) -> list[Saved]:
        return [one for of_host in await self._ask_all("save") for one in of_host]

    async def restore(self, request: Restore) -> None:
        await self._ask(self._host_of(request.saved.id), "restore", request)

    def _host_of(self, session: str) -> int:
        number = session.rpartition(".")[2]
        if number.isascii() and number.isdigit() and len(number) <= 4 and int(number) < len(self._hosts):
            return int(number)
        return crc32(session.encode()) % len(self._hosts)  # of one that was saved by another engine

    async def _ask(self, host: int, operation: str, *arguments: Any) -> Any:
        try:
            reply = await cast(Awaitable[Any], self._hosts[host].ask.remote(operation, *arguments))
        except RayActorError as error:
            raise Unavailable(f"session host {host} has ended and is started again: try again later") from error
        if isinstance(reply, Refused):
            raise reply.error
        return reply

    async def _ask_all(self, operation: str, *arguments: Any) -> list[Any]:
        return await asyncio.gather(*(self._ask(host, operation, *arguments) for host in range(len(self._hosts))))


def _together(found: Sequence[Counts]) -> Counts:
    sessions: Counter[str] = Counter()
    for counts in found:
        sessions.update(counts.sessions)
    return Counts(
        sessions=sessions,
        lanes=sum(counts.lanes for counts in found),
        requests=sum(counts.requests for counts in found),
        steps=Durations.together([counts.steps for counts in found]),
        lane_steps=sum(counts.lane_steps for counts in found),
        expired=sum(counts.expired for counts in found),
    )
