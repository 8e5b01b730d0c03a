"""The open sessions of this process by id: expiry, limits, deadlines, and threads for long requests.

Only ``check_wanted`` may be called outside the event loop's thread.
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

# If the predicted duration of a request is below this number of seconds, it runs in the event loop. A thread would add
# about 70 us, and several times as much on a busy machine. So short a request hardly delays other sessions.
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
    reserved: int = 0  # number of bytes that the session was expected to take when it was opened
    seconds_per_step: float = float("inf")  # moving average of measured step durations; infinite before the first step
    requests: int = 0  # number of this session's requests that run or wait

    @property
    def nbytes(self) -> int:
        return max(self.reserved, self.session.nbytes)


@dataclass
class Threads:
    """Pool of threads for long requests, with the predicted duration of each request in it."""

    executor: Executor
    workers: int  # number of threads in the pool
    queued: list[float] = field(default_factory=list)  # predicted seconds of each running or waiting request

    @property
    def wait(self) -> float:
        """Predicted time in seconds until a new request would begin in this pool."""
        return sum(self.queued) / self.workers if len(self.queued) >= self.workers else 0.0


@dataclass(frozen=True)
class Limits:
    """Limits on the number, the memory and the requests of all sessions of this process together."""

    sessions: int = 256
    nbytes: int = 2048 * MEBIBYTE  # largest memory in bytes of all sessions: their lanes and their stored last answers
    requests: int = 1_024  # largest number of requests of all sessions that run or wait at the same time


class LiveSessions:
    """The open sessions by id. A session runs one request at a time; a long request runs in a thread.

    Args:
        threads: threads for long steps and resets.
        rollouts: threads for long rollouts, which may take minutes, so that steps don't wait behind them.
        limits: limits of all sessions together, beyond which requests are refused.
        idle_seconds: a session without requests for this long expires.
        clock: returns the time in seconds, also for deadlines.
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
            raise Overloaded(
                f"expected at most {self._limits.sessions} open sessions, got one more: close a session, or try later"
            )
        self._check_memory(nbytes)

    def add(self, session: Session, reserved: int = 0) -> Session:
        """Add an open session. It counts as at least ``reserved`` bytes of memory. Raises the errors of
        ``check_room``."""
        live = _Live(session, self.clock(), reserved=reserved)
        self.check_room(live.nbytes)
        self._live[session.id] = live
        return session

    def get(self, id: str) -> Session:
        """Return a session's present state. Raises ``SessionExpired`` or ``UnknownSession``."""
        return self._get(id).session

    def opened_by(self, surrogate: str, key: str, digest: str) -> Session | None:
        """Return the session of a surrogate that was opened with this idempotency key; None if there is none.

        Raises:
            IdempotencyConflict: the content hash of its opening is not ``digest``.
        """
        for session in self:
            if session.opened_by is not None and (session.surrogate, session.opened_by[0]) == (
                surrogate,
                key,
            ):
                return check_opening(session, digest)
        return None

    def prompt(self, id: str, steps: int = 1) -> bool:
        """Return whether a request of ``steps`` steps can run at once in the event loop: the session has no other
        request, and the predicted duration is short."""
        live = self._live.get(id)
        if live is None or live.requests or self._requests >= self._limits.requests:
            return False
        return live.seconds_per_step * steps < INLINE_SECONDS

    def advance_now(
        self, id: str, seq: int | None, request: Fingerprint, work: Work, steps: int = 1, deadline: float | None = None
    ) -> Answer:
        """Carry out a request like ``advance``, but at once in the caller's thread. May only be called if ``prompt``
        returns True."""
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
        """Carry out a request once, and keep its outcome as the session's last answer.

        A repeat, with the same sequence number and content hash, gets that answer, even if it arrives while the first
        request still runs. A request that raises an error changes nothing.

        Args:
            id: id of the session.
            seq: sequence number of the request, the session's next one; None if a repeat need not be recognised.
            request: content hash of the request.
            work: pure function from the session to the new session and the outcome.
            steps: number of virtual steps, to predict the duration.
            deadline: time of ``clock``; a request that would end later is not begun.

        Raises:
            SeqConflict: ``seq`` is neither the next sequence number nor that of the last request.
            Overloaded: too many requests are running or waiting.
            DeadlineExceeded: the request would end after the deadline.
            SessionExpired, UnknownSession: the session has expired, or does not exist.
        """
        live = self._get(id)
        if self._requests >= self._limits.requests:
            raise Overloaded(
                f"expected at most {self._limits.requests} requests of all sessions at once, got one more: try later"
            )
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
        """Check, between two steps of a long request, that the request may continue. Thread-safe.

        Raises:
            UnknownSession: the session was closed during the request.
            Unavailable: this process shuts down.
        """
        if self._stopping:
            raise Unavailable("the server is stopping and took no step of this request: send it again after a restart")
        if id not in self._live:
            raise UnknownSession(f"session {id!r} was closed during this request: open a new one")

    def stop(self) -> None:
        """Stop long requests: their next call of ``check_wanted`` raises ``Unavailable``."""
        self._stopping = True

    def close(self, id: str) -> None:
        """End a session. Does nothing if the session has ended already."""
        self._live.pop(id, None)

    def close_all_of(self, surrogate: int) -> None:
        """End all sessions of a surrogate; ``surrogate`` is its id."""
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
        raise UnknownSession(f"expected the id of an open session, got {id!r}: open a new session")

    def _check_memory(self, nbytes: int) -> None:
        most, total = self._limits.nbytes, sum(live.nbytes for live in self._live.values())
        if nbytes > most:
            raise TooLarge(
                f"expected a session and its reply to take at most {_mebibytes(most)} of memory, got "
                f"{_mebibytes(nbytes)}: "
                "open fewer lanes, take fewer steps in one request, or start the server with a larger "
                "SURROGYM_MAX_SESSIONS_MIB"
            )
        if total + nbytes > most:
            raise Overloaded(
                f"expected all sessions to take at most {_mebibytes(most)} of memory, got {_mebibytes(total)} and "
                f"{_mebibytes(nbytes)} more: close some sessions, or try later"
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
            # Check the deadline again, because the request may have waited longer for a thread than predicted.
            self._check_deadline(deadline, expected)
            return work(session)

        threads.queued.append(expected)
        try:
            return await asyncio.get_running_loop().run_in_executor(threads.executor, _timed, in_time, session)
        finally:
            threads.queued.remove(expected)

    def _check_deadline(self, deadline: float | None, seconds: float) -> None:
        if deadline is not None and (left := deadline - self.clock()) < seconds:
            raise DeadlineExceeded(
                f"the request would take {1e3 * seconds:.0f} ms, and {1e3 * max(left, 0):.0f} ms are left until its "
                "deadline: nothing was computed; allow more time"
            )


def _with_measurement(
    live: _Live, result: tuple[Session, Outcome], seconds: float, steps: int
) -> tuple[Session, Outcome]:
    """Update the session's moving average of the time per step with a request of ``steps`` steps that took ``seconds``.
    Return ``result`` unchanged."""
    outcome = result[1]
    # A policy's rollout may stop after fewer steps than requested.
    count = len(outcome) if isinstance(outcome, PolicyRollout) else steps
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
    """One lock for each surrogate, so that its sessions are opened one after the other.

    A repeated request then finds the session that its idempotency key has opened. Sessions of other surrogates open at
    the same time, because loading a large model takes long.
    """

    def __init__(self) -> None:
        self._locks = WeakValueDictionary[int, asyncio.Lock]()

    def of(self, surrogate: int) -> asyncio.Lock:
        """Return the lock of the surrogate with this id. The lock exists as long as a request holds or awaits it."""
        return self._locks.setdefault(surrogate, asyncio.Lock())
