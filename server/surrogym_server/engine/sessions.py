"""The live sessions of this process; everyone else knows only their ids.

All methods belong to the event loop's thread.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field

from surrogym_server.engine.session import Answer, Outcome, Session, answered, check_opening, replay
from surrogym_server.errors import Overloaded, SessionExpired, UnknownSession

# Work below this is done in the event loop: a hop to a thread and back costs about 70 us idle and several times
# that on a busy machine, and nobody else notices a wait of two milliseconds.
INLINE_SECONDS = 2e-3
REMEMBERED_EXPIRED = 10_000
FORGETTING = 0.2

Work = Callable[[Session], tuple[Session, Outcome]]


@dataclass
class _Live:
    session: Session
    used: float
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    seconds_per_step: float = float("inf")  # measured, so unknown before the first


class LiveSessions:
    """Sessions by id: one request at a time in each, long ones in a thread."""

    def __init__(
        self,
        threads: Executor,
        *,
        limit: int,
        idle_seconds: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.idle_seconds = idle_seconds
        self._threads = threads
        self._limit = limit
        self._clock = clock
        self._live: dict[str, _Live] = {}
        self._expired: OrderedDict[str, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._live)

    def __iter__(self) -> Iterator[Session]:
        return iter([live.session for live in self._live.values()])

    def add(self, session: Session) -> Session:
        """Keep a session.

        Raises:
            Overloaded: as many as the limit are open.
        """
        if len(self._live) >= self._limit:
            raise Overloaded(f"expected fewer than {self._limit} open sessions: close some, or try again later")
        self._live[session.id] = _Live(session, self._clock())
        return session

    def get(self, id: str) -> Session:
        """The session as it is now. Raises ``SessionExpired`` or ``UnknownSession``."""
        return self._get(id).session

    def opened_by(self, surrogate: str, key: str, digest: str) -> Session | None:
        """The session that an idempotency key opened, if it is there. Raises ``IdempotencyConflict``."""
        for session in self:
            if session.opened_by is not None and (session.surrogate, session.opened_by[0]) == (
                surrogate,
                key,
            ):
                return check_opening(session, digest)
        return None

    async def advance(self, id: str, seq: int | None, digest: str, work: Work, steps: int = 1) -> Answer:
        """Do the work of a request once, and keep its outcome as the session's last answer.

        The same seq with the same digest gets the kept answer, also when it comes while the first is being
        computed. Work that raises changes nothing.

        Args:
            id: of the session.
            seq: the session's next one, or None to give up replay.
            digest: fingerprint of the request.
            work: from the session to the new session and the outcome; pure.
            steps: how many virtual steps it takes, to predict how long.

        Raises:
            SeqConflict: neither the next seq nor a repeat.
            SessionExpired, UnknownSession: as the classes say.
        """
        live = self._get(id)
        async with live.lock:
            self._get(id).used = self._clock()
            if kept := replay(live.session, seq, digest):
                return kept
            session, outcome = await self._do(live, work, steps)
            live.session, answer = answered(session, digest, outcome)
            live.used = self._clock()
            return answer

    def close(self, id: str) -> None:
        """End a session; harmless when it has ended."""
        self._live.pop(id, None)

    def close_all_of(self, surrogate: str) -> None:
        """End the sessions of a surrogate."""
        for session in self:
            if session.surrogate == surrogate:
                self.close(session.id)

    def sweep(self) -> list[str]:
        """Expire the sessions that were idle for too long; returns their ids."""
        now = self._clock()
        idle = [id for id, live in self._live.items() if now - live.used > self.idle_seconds and not live.lock.locked()]
        for id in idle:
            del self._live[id]
            self._expired[id] = None
        while len(self._expired) > REMEMBERED_EXPIRED:
            self._expired.popitem(last=False)
        return idle

    def _get(self, id: str) -> _Live:
        if live := self._live.get(id):
            return live
        if id in self._expired:
            raise SessionExpired(f"session {id!r} was idle for more than {self.idle_seconds:g} s: open a new one")
        raise UnknownSession(f"no session {id!r}: open a new one")

    async def _do(self, live: _Live, work: Work, steps: int) -> tuple[Session, Outcome]:
        session, inline = live.session, live.seconds_per_step * steps < INLINE_SECONDS
        if inline:
            done, seconds = _timed(work, session)
        else:
            loop = asyncio.get_running_loop()
            done, seconds = await loop.run_in_executor(self._threads, _timed, work, session)
        known = live.seconds_per_step if live.seconds_per_step < float("inf") else seconds / steps
        live.seconds_per_step = (1 - FORGETTING) * known + FORGETTING * seconds / steps
        return done


def _timed(work: Work, session: Session) -> tuple[tuple[Session, Outcome], float]:
    start = time.perf_counter()
    done = work(session)
    return done, time.perf_counter() - start
