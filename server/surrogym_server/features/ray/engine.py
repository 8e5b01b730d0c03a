"""``RayEngine``: sends the requests of sessions to session hosts, processes of a Ray cluster that run the sessions."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, cast
from zlib import crc32

import ray
from ray.exceptions import RayActorError, RayError

from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, Array, Open, Reply, Restore, Saved, SessionInfo, Visited
from surrogym_server.engine.session import digest_of
from surrogym_server.engine.tallies import Counts, Durations, SessionActivity
from surrogym_server.errors import IdempotencyConflict, Overloaded, Unavailable, UnknownSession
from surrogym_server.features.ray.host import HostSettings, Refused
from surrogym_server.features.ray.store import LiveSessions

logger = logging.getLogger(__name__)

ANSWERING_SECONDS, TAKING_SECONDS = 5.0, 60.0  # longest wait for a host to answer a ping, and to take over a session
ENDED, SILENT = "has ended and is started again", "does not answer now"
MOVES = 3  # largest number of hosts that one request tries while its session changes hosts
REMEMBERED = 10_000  # largest number of sessions whose host is cached, because it is not the host that their id names


class _Gone(Exception):
    """A session host has died, does not answer, or no longer has the session."""


class RayEngine(SessionEngine):
    """Engine that sends each request to the session host that runs the session.

    The id of a session ends with the number of the host that opened it. If that host no longer has the session, the
    database names the host that has it. If the session's lease has expired, another host takes it over.

    Args:
        hosts: Ray's actor handles of the ``SessionHost`` processes, by number.
        machines: kind of machine of each host, as ``machine_kind`` returns it.
        store: records of the sessions in the database.
        settings: settings of the hosts.
    """

    lasting = True
    replay = 10_000  # number of last requests that a client should keep, to repeat those since the last checkpoint

    def __init__(
        self, hosts: Sequence[Any], machines: Sequence[str], store: LiveSessions, settings: HostSettings
    ) -> None:
        self.idle_seconds = settings.idle_seconds
        self._pool = settings.pool
        self._hosts = tuple(hosts)
        self._machines = tuple(machines)
        self._store = store
        self._patience = settings.pace.lease_seconds / 2
        self._turns = itertools.count()
        self._places: OrderedDict[str, int] = OrderedDict()
        self._away: set[int] = set()  # hosts that were logged as dead or silent

    async def open(self, request: Open) -> SessionInfo:
        key, turn = request.opening.key, next(self._turns)
        if key is not None:
            if (known := await asyncio.to_thread(self._store.opened, request.surrogate_id, key)) is not None:
                if known[1] != digest_of("open", request.opening):
                    raise IdempotencyConflict(
                        "this idempotency key has opened a session with other settings: use a new key"
                    )
                return await self.describe(known[0])
            turn = crc32(f"{request.surrogate}|{key}".encode())
        for host in self._in_turn(turn):
            if await self._lives(host):
                return cast(SessionInfo, await self._reply(host, "open", request))
        raise Unavailable("no session host answers now: try again later")

    async def advance(self, request: Advance) -> Reply:
        return cast(Reply, await self._of(request.session, "advance", request))

    async def describe(self, session: str) -> SessionInfo:
        return cast(SessionInfo, await self._of(session, "describe", session))

    async def coordinates(self, session: str) -> Array:
        return cast(Array, await self._of(session, "coordinates", session))

    async def submit(self, session: str) -> Visited:
        return cast(Visited, await self._of(session, "submit", session))

    async def close(self, session: str) -> None:
        holder = await asyncio.to_thread(self._store.holder, session)
        await asyncio.to_thread(self._store.remove, session)
        self._places.pop(session, None)
        # A host that does not answer now will end the session later, when it finds that the record is removed.
        with suppress(Unavailable, TimeoutError):
            async with asyncio.timeout(ANSWERING_SECONDS):
                host = _number(holder.owner) if holder else self._place(session)
                if host < len(self._hosts):
                    await self._reply(host, "close", session)

    async def forget(self, surrogate: int) -> None:
        await asyncio.to_thread(self._store.remove_all_of, surrogate)
        await self._ask_all("forget", surrogate)

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        return [one for of_host in await self._ask_all("activity", surrogate) for one in of_host]

    def counts(self) -> Counts:
        """Return the counts of all hosts that answer, added together."""
        asked = [host.counts.remote() for host in self._hosts]
        answers, _ = ray.wait(asked, num_returns=len(asked), timeout=ANSWERING_SECONDS)
        found: list[Counts] = []
        for answer in answers:
            with suppress(RayError):  # the host has died, so it has no sessions
                found.append(ray.get(answer))
        return _together(found)

    async def sweep(self) -> None:
        await self._ask_all("sweep")
        await asyncio.to_thread(self._store.sweep, self.idle_seconds)

    async def start(self) -> None:
        """Do nothing, because the hosts have started already."""

    async def stop(self) -> None:
        """Do nothing, because other servers of the cluster use the hosts too."""

    async def save(self) -> list[Saved]:
        return [one for of_host in await self._ask_all("save") for one in of_host]

    async def restore(self, request: Restore) -> None:
        await self._reply(self._place(request.saved.id), "restore", request)

    async def _of(self, session: str, operation: str, *arguments: Any) -> Any:
        """Send an operation to the host that has a session now, and return its reply."""
        host = self._place(session)
        for _ in range(MOVES):
            try:
                return await self._answer(session, host, operation, *arguments)
            except (UnknownSession, _Gone) as error:
                host = await self._moved(session, host, error)
        raise Unavailable(f"session {session!r} is moving to another session host: try again later")

    def _place(self, session: str) -> int:
        if (known := self._places.get(session)) is not None:
            return known
        number = session.rpartition(".")[2]
        if number.isascii() and number.isdigit() and len(number) <= 4 and int(number) < len(self._hosts):
            return int(number)
        return crc32(session.encode()) % len(self._hosts)  # the id has no host's number: another engine made it

    async def _moved(self, session: str, asked: int, error: Exception) -> int:
        """Return the number of the host that has a session, after the host ``asked`` failed with ``error``.

        If the session's lease has expired, another host takes the session over first. Raises ``UnknownSession`` or
        ``Unavailable``.
        """
        holder = await asyncio.to_thread(self._store.holder, session)
        if holder is None:
            self._places.pop(session, None)
            unknown = UnknownSession(f"no session {session!r}: open a new one")
            raise error if isinstance(error, UnknownSession) else unknown
        if holder.seconds_left <= 0:
            return self._remember(session, await self._taken(session, asked, holder.machine))
        if _pool(holder.owner) != self._pool:
            raise Unavailable(
                f"session {session!r} belongs for {holder.seconds_left:.1f} s more to session hosts that this front "
                "server does not use: expected the same Ray cluster and the same --database at all front servers"
            )
        host = _number(holder.owner)
        if host == asked:
            raise Unavailable(
                f"session host {host} has ended, and another one takes over session {session!r} in "
                f"{holder.seconds_left:.1f} s: try again later"
            )
        return self._remember(session, host)

    async def _taken(self, session: str, asked: int, machine: str) -> int:
        """Let another host on a machine of this kind take over a session whose lease has expired. Return its number.

        Raises ``UnknownSession`` if there is no such host, and ``Unavailable`` if none can take it now.
        """
        alike = [host for host in self._in_turn(asked + 1) if self._machines[host] == machine]
        if not alike:
            await asyncio.to_thread(self._store.remove, session)
            raise UnknownSession(
                f"session {session!r} was lost with its session host: no host of the same kind of machine is left, and "
                "another kind rounds numbers differently; open a new session"
            )
        for host in alike:
            if not await self._lives(host):
                continue
            with suppress(Overloaded, TimeoutError):
                async with asyncio.timeout(TAKING_SECONDS):
                    await self._reply(host, "take", session)
                logger.info(
                    "session %s goes on at session host %d: the lease of its last host has ended", session, host
                )
                return host
        raise Unavailable(f"no session host can take session {session!r} now: try again later")

    def _in_turn(self, first: int) -> list[int]:
        return [(first + offset) % len(self._hosts) for offset in range(len(self._hosts))]

    def _remember(self, session: str, host: int) -> int:
        self._places[session] = host
        self._places.move_to_end(session)
        while len(self._places) > REMEMBERED:
            self._places.popitem(last=False)
        return host

    async def _lives(self, host: int) -> bool:
        """Whether a host answers within ``ANSWERING_SECONDS``."""
        try:
            async with asyncio.timeout(ANSWERING_SECONDS):
                await cast(Awaitable[None], self._hosts[host].ping.remote())
        except RayActorError:
            self._note_away(host, ENDED)
            return False
        except TimeoutError:
            self._note_away(host, SILENT)
            return False
        if host in self._away:
            self._away.discard(host)
            logger.info("session host %d answers again", host)
        return True

    def _note_away(self, host: int, what: str) -> None:
        """Log that a host is dead or silent. This is logged once, until the host answers again."""
        if host not in self._away:
            self._away.add(host)
            logger.warning("session host %d %s: its sessions go on at another one when its lease has ended", host, what)

    async def _answer(self, session: str, host: int, operation: str, *arguments: Any) -> Any:
        """Send an operation to a host, and wait for the reply as long as the host has the session.

        Raises:
            _Gone: the host has died, does not answer, or no longer has the session.
            SurrogymError: the host refused the request.
        """
        return await self._heard(host, partial(self._has_left, session, host), operation, *arguments)

    async def _has_left(self, session: str, host: int) -> bool:
        """Whether a host no longer has a session: another host has it, or its lease expired and the host is silent."""
        holder = await asyncio.to_thread(self._store.holder, session)
        if holder is None or _number(holder.owner) != host:
            return True
        return holder.seconds_left <= 0 and await self._is_silent(host)

    async def _is_silent(self, host: int) -> bool:
        return not await self._lives(host)

    async def _reply(self, host: int, operation: str, *arguments: Any) -> Any:
        """Send an operation to a host, and wait for the reply as long as the host answers pings.

        Raises ``Unavailable`` if the host dies or does not answer, and the errors of the operation.
        """
        try:
            return await self._heard(host, partial(self._is_silent, host), operation, *arguments)
        except _Gone as gone:
            raise Unavailable(f"session host {host} {gone}: try again later") from gone

    async def _heard(self, host: int, is_gone: Callable[[], Awaitable[bool]], operation: str, *arguments: Any) -> Any:
        """Send an operation to a host, and wait for the reply. Call ``is_gone`` each time that half the duration of a
        lease has passed.

        Raises:
            _Gone: the host has died, or ``is_gone`` returned True.
            SurrogymError: the host refused the request.
        """
        asked = self._hosts[host].ask.remote(operation, *arguments)
        while True:
            try:
                async with asyncio.timeout(self._patience):
                    return _said(await cast(Awaitable[Any], asked))
            except RayActorError as error:
                self._note_away(host, ENDED)
                raise _Gone(ENDED) from error
            except TimeoutError:
                if await is_gone():
                    raise _Gone(SILENT) from None

    async def _ask_all(self, operation: str, *arguments: Any) -> list[Any]:
        """Send an operation to all hosts, and return the replies of those that answer."""
        replies = await asyncio.gather(*(self._asked(host, operation, *arguments) for host in range(len(self._hosts))))
        return [reply for reply in replies if not isinstance(reply, _Gone)]

    async def _asked(self, host: int, operation: str, *arguments: Any) -> Any:
        if not await self._lives(host):
            return _Gone()
        try:
            return await self._heard(host, partial(self._is_silent, host), operation, *arguments)
        except _Gone as gone:
            return gone


def _number(owner: str) -> int:
    """Return the number of a session host, given the name under which it owns leases."""
    return int(owner.split()[0])


def _pool(owner: str) -> str:
    """Return the id of the pool of a session host, given the name under which the host owns leases."""
    return owner.split()[1]


def _said(reply: Any) -> Any:
    if isinstance(reply, Refused):
        raise reply.error
    return reply


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
