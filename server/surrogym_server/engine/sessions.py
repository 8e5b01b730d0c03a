"""The live sessions of this process. Other parts of the program only know their ids.

All methods but ``check_wanted`` belong to the event loop's thread.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field
from weakref import WeakValueDictionary

from surrogym_server.engine.session import (
    Answer,
    Fingerprint,
    Outcome,
    Session,
    answered,
    check_opening,
    replay,
)
from surrogym_server.errors import DeadlineExceeded, Overloaded, SessionExpired, TooLarge, Unavailable, UnknownSession
from surrogym_shared.port import PolicyRollout

logger = logging.getLogger(__name__)

# Requests predicted to be shorter run in the event loop. A thread would add about 70 us, and several times that on a
# busy machine; other sessions don't notice a wait of two milliseconds.
INLINE_SECONDS = 2e-3
MEBIBYTE = 2**20
REMEMBERED_EXPIRED = 10_000
FORGETTING = 0.2

Work = Callable[[Session], tuple[Session, Outcome]]


@dataclass
class _Live:
    session: Session
    last_use: float
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    reserved: int = 0  # bytes that the session may grow to
    seconds_per_step: float = float("inf")  # moving average of measurements; infinite before the first step
    requests: int = 0  # requests of this session that run or wait

    @property
    def nbytes(self) -> int:
        return max(self.reserved, self.session.nbytes)


@dataclass
class Threads:
    """Pool of threads for long requests, with the predicted time of its queue."""

    executor: Executor
    workers: int  # number of threads
    queued: list[float] = field(default_factory=list)  # predicted seconds of each request that runs or waits

    @property
    def wait(self) -> float:
        """Predicted seconds until a new request would begin in this pool."""
        return sum(self.queued) / self.workers if len(self.queued) >= self.workers else 0.0


@dataclass(frozen=True)
class Limits:
    """Limits of all sessions of this process together."""

    sessions: int = 256
    nbytes: int = 2048 * MEBIBYTE  # memory of all lanes and kept answers
    requests: int = 1_024  # requests that run or wait


class LiveSessions:
    """Sessions by id. Each runs one request at a time, and long ones in a thread.

    Args:
        threads: for long steps and resets.
        rollouts: for long rollouts, which may take minutes, so that steps don't queue behind them.
        limits: requests beyond them are refused.
        idle_seconds: a session without requests for this long expires.
        clock: seconds, also for deadlines.
    """

    def __init__(
        self,
        threads: Threads,
        rollouts: Threads,
        *,
        limits: Limits,
        idle_seconds: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.idle_seconds = idle_seconds
        self.clock = clock
        self._threads = threads
        self._rollouts = rollouts
        self._limits = limits
        self._requests = 0
        self._live: dict[str, _Live] = {}
        self._stopping = False
        self._expired: OrderedDict[str, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._live)

    def __iter__(self) -> Iterator[Session]:
        return iter([live.session for live in list(self._live.values())])

    @property
    def requests(self) -> int:
        """Number of requests that run or wait, in all sessions."""
        return self._requests

    def check_room(self, nbytes: int) -> None:
        """Check that a session of this size in bytes may be opened.

        Raises:
            TooLarge: the session would take more memory than all sessions together may.
            Overloaded: the number of open sessions, or their memory, has reached its limit.
        """
        if len(self._live) >= self._limits.sessions:
            raise Overloaded(f"expected fewer than {self._limits.sessions} open sessions: close some, or try later")
        self._check_memory(nbytes)

    def add(self, session: Session, reserved: int = 0) -> Session:
        """Add an open session, which may grow to ``reserved`` bytes. Raises like ``check_room``."""
        live = _Live(session, self.clock(), reserved=reserved)
        self.check_room(live.nbytes)
        self._live[session.id] = live
        return session

    def get(self, id: str) -> Session:
        """Return a session's present state. Raises ``SessionExpired`` or ``UnknownSession``."""
        return self._get(id).session

    def opened_by(self, surrogate: str, key: str, digest: str) -> Session | None:
        """Return the session that an idempotency key opened, or None. Raises ``IdempotencyConflict``."""
        for session in self:
            if session.opened_by is not None and (session.surrogate, session.opened_by[0]) == (
                surrogate,
                key,
            ):
                return check_opening(session, digest)
        return None

    def prompt(self, id: str, steps: int = 1) -> bool:
        """Whether ``advance`` would take ``steps`` of a session at once: nothing waits, and the steps are short."""
        live = self._live.get(id)
        if live is None or live.requests or self._requests >= self._limits.requests:
            return False
        return live.seconds_per_step * steps < INLINE_SECONDS

    def advance_now(
        self, id: str, seq: int | None, request: Fingerprint, work: Work, steps: int = 1, deadline: float | None = None
    ) -> Answer:
        """Do ``advance`` at once, in the caller's thread. Allowed only if ``prompt`` has returned True."""
        live = self._get(id)
        live.last_use = self.clock()
        if repeat := replay(live.session, seq, request):
            return repeat
        if steps > 1:
            self._check_memory(live.session.answer_bytes(steps))
        return self._keep(live, request, self._done_now(live, work, steps, deadline))

    async def advance(
        self, id: str, seq: int | None, request: Fingerprint, work: Work, steps: int = 1, deadline: float | None = None
    ) -> Answer:
        """Carry a request out once, and keep its outcome as the session's last answer.

        A repeat, with the same seq and fingerprint, gets that answer, even if it arrives while the first request is
        still being computed. A request that raises an error changes nothing.

        Args:
            id: the session's id.
            seq: sequence number of the request, the session's next one; None gives up replay.
            request: fingerprint of the request.
            work: pure function from the session to the new session and the outcome.
            steps: number of virtual steps, to predict the duration.
            deadline: time by the clock; a request that would end later is not begun.

        Raises:
            SeqConflict: neither the next seq nor a repeat.
            Overloaded: too many requests are running or waiting.
            DeadlineExceeded: it would end after the deadline.
            SessionExpired, UnknownSession: as the classes say.
        """
        live = self._get(id)
        if self._requests >= self._limits.requests:
            raise Overloaded(f"expected at most {self._limits.requests} requests of sessions at once: try again later")
        self._requests += 1
        live.requests += 1
        try:
            async with live.lock:
                self._get(id).last_use = self.clock()
                if repeat := replay(live.session, seq, request):
                    return repeat
                if steps > 1:
                    self._check_memory(live.session.answer_bytes(steps))
                return self._keep(live, request, await self._do(live, work, steps, deadline))
        finally:
            self._requests -= 1
            live.requests -= 1

    def check_wanted(self, id: str) -> None:
        """Check, between two steps of a long request, that it may continue. Any thread may call it.

        Raises:
            UnknownSession: the session was closed meanwhile.
            Unavailable: this process shuts down.
        """
        if self._stopping:
            raise Unavailable("the server is stopping and took no step of this request: send it again")
        if id not in self._live:
            raise UnknownSession(f"session {id!r} was closed during this request")

    def stop(self) -> None:
        """Make running long requests end at their next call of ``check_wanted``."""
        self._stopping = True

    def close(self, id: str) -> None:
        """End a session. Harmless if it has ended."""
        self._live.pop(id, None)

    def close_all_of(self, surrogate: int) -> None:
        """End the sessions of a surrogate, by its id."""
        for session in self:
            if session.surrogate_id == surrogate:
                self.close(session.id)

    def sweep(self) -> list[str]:
        """End the sessions that were idle for too long, and return their ids."""
        now = self.clock()
        idle = [
            id for id, live in self._live.items() if now - live.last_use > self.idle_seconds and not live.lock.locked()
        ]
        for id in idle:
            del self._live[id]
            self._expired[id] = None
            logger.info("session %s was idle and has expired", id)
        while len(self._expired) > REMEMBERED_EXPIRED:
            self._expired.popitem(last=False)
        return idle

    def _get(self, id: str) -> _Live:
        if live := self._live.get(id):
            return live
        if id in self._expired:
            raise SessionExpired(f"session {id!r} was idle for more than {self.idle_seconds:g} s: open a new one")
        raise UnknownSession(f"no session {id!r}: open a new one")

    def _check_memory(self, nbytes: int) -> None:
        most, total = self._limits.nbytes, sum(live.nbytes for live in self._live.values())
        if nbytes > most:
            raise TooLarge(
                f"expected a session and its reply to take at most {_mebibytes(most)} of memory, got "
                f"{_mebibytes(nbytes)}: "
                "open fewer lanes, take fewer steps in one request, or start the server with a larger "
                "--max-sessions-mib"
            )
        if total + nbytes > most:
            raise Overloaded(
                f"expected all sessions to take at most {_mebibytes(most)}, got {_mebibytes(total)} "
                f"and {_mebibytes(nbytes)} more: close some, or try later"
            )

    def _keep(self, live: _Live, request: Fingerprint, result: tuple[Session, Outcome]) -> Answer:
        live.session, answer = answered(result[0], request, result[1])
        live.last_use = self.clock()
        return answer

    async def _do(self, live: _Live, work: Work, steps: int, deadline: float | None) -> tuple[Session, Outcome]:
        seconds_ahead = live.seconds_per_step * steps
        if seconds_ahead < INLINE_SECONDS:
            return self._done_now(live, work, steps, deadline)
        threads = self._threads if steps == 1 else self._rollouts
        result, seconds = await self._in_thread(threads, live.session, work, seconds_ahead, deadline)
        return _with_measurement(live, result, seconds, steps)

    def _done_now(self, live: _Live, work: Work, steps: int, deadline: float | None) -> tuple[Session, Outcome]:
        self._check_deadline(deadline, live.seconds_per_step * steps)
        result, seconds = _timed(work, live.session)
        return _with_measurement(live, result, seconds, steps)

    async def _in_thread(
        self, threads: Threads, session: Session, work: Work, expected: float, deadline: float | None
    ) -> tuple[tuple[Session, Outcome], float]:
        expected = expected if expected < float("inf") else 0.0
        self._check_deadline(deadline, threads.wait + expected)

        def in_time(session: Session) -> tuple[Session, Outcome]:
            self._check_deadline(
                deadline, expected
            )  # checked again, because the wait may have been longer than predicted
            return work(session)

        threads.queued.append(expected)
        try:
            return await asyncio.get_running_loop().run_in_executor(threads.executor, _timed, in_time, session)
        finally:
            threads.queued.remove(expected)

    def _check_deadline(self, deadline: float | None, seconds: float) -> None:
        if deadline is not None and (left := deadline - self.clock()) < seconds:
            raise DeadlineExceeded(
                f"the request would take {1e3 * seconds:.0f} ms, and {1e3 * max(left, 0):.0f} ms are left of the "
                "time that it "
                "allows: nothing was computed; allow more time"
            )


def _with_measurement(
    live: _Live, result: tuple[Session, Outcome], seconds: float, steps: int
) -> tuple[Session, Outcome]:
    """Update the session's predicted seconds per step by a measurement, and pass the result on."""
    outcome = result[1]
    count = len(outcome) if isinstance(outcome, PolicyRollout) else steps  # a policy's rollout may have stopped early
    each = seconds / count
    average = live.seconds_per_step if live.seconds_per_step < float("inf") else each
    live.seconds_per_step = (1 - FORGETTING) * average + FORGETTING * each
    return result


def _mebibytes(nbytes: int) -> str:
    return f"{nbytes / MEBIBYTE:.1f} MiB"


def _timed(work: Work, session: Session) -> tuple[tuple[Session, Outcome], float]:
    start = time.perf_counter()
    result = work(session)
    return result, time.perf_counter() - start


class OpeningLocks:
    """A lock for each surrogate: its sessions are opened one after the other, so that a repeat finds the session of its
    key. Openings of other surrogates don't wait: a large model takes long to load and to draw functions from."""

    def __init__(self) -> None:
        self._locks = WeakValueDictionary[int, asyncio.Lock]()

    def of(self, surrogate: int) -> asyncio.Lock:
        """The lock of a surrogate, by its id. It exists as long as somebody holds it or waits for it."""
        return self._locks.setdefault(surrogate, asyncio.Lock())
