"""``LocalEngine``: runs sessions in this process, short requests in the event loop and long ones in threads.

``LiveSessions`` holds the open sessions by id, with expiry, limits and deadlines. Only its method ``check_wanted`` may
be called outside the event loop's thread.
"""

from __future__ import annotations

import asyncio
import logging
import subprocess
import sys
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from weakref import WeakValueDictionary

import torch

from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import (
    Advance,
    Array,
    Open,
    Reply,
    Reset,
    Restore,
    Saved,
    SessionInfo,
    Visited,
    carried_out,
    check_gpu,
    check_size,
    fingerprint_of,
    info_of,
    opened,
    steps_asked,
    visited_states,
)
from surrogym_server.engine.session import (
    Answer,
    Fingerprint,
    Outcome,
    Session,
    answered,
    check_opening,
    digest_of,
    replay,
    session_from_bytes,
    session_to_bytes,
    steps_of,
)
from surrogym_server.engine.tallies import Counts, Durations, SessionActivity, Tallies
from surrogym_server.errors import DeadlineExceeded, Overloaded, SessionExpired, TooLarge, Unavailable, UnknownSession
from surrogym_server.models.draws import function_draws
from surrogym_server.models.guard import plugin_calls
from surrogym_server.sampling.uncertainty import visited_confidence
from surrogym_server.tensors import CPU, gpu_calls, gpu_failure
from surrogym_server.virtual import expected_bytes
from surrogym_shared import compiled
from surrogym_shared.compiled import disk_cache
from surrogym_shared.port import PolicyRollout

STEP_THREADS, ROLLOUT_THREADS = 4, 2
# Function that returns the tolerances (O,) of the O outputs of a model, given a surrogate's id and a model version.
Tolerances = Callable[[int, int], tuple[float, ...]]


class LocalEngine(SessionEngine):
    """Engine that runs sessions in this process. Only ``counts`` may be called outside the event loop's thread.

    Args:
        models: models of all surrogates.
        tolerances: function from a surrogate's id and a model version to the tolerances (O,) of that model.
        limits: limits of all sessions together.
        max_lanes: largest number of lanes of one session.
        idle_seconds: a session without requests for this long expires.
        device: device that computes steps; requests and replies are on the CPU.
        place: suffix of the session ids, which distinguishes the engines of several processes.
    """

    def __init__(  # not grouped into one object, because each parameter comes from a different part of the server
        self,
        models: ModelCache,
        tolerances: Tolerances,
        *,
        limits: Limits,
        max_lanes: int,
        idle_seconds: float,
        device: torch.device = CPU,
        place: str = "",
    ) -> None:
        self.idle_seconds = idle_seconds
        self._models = models
        self._tolerances = tolerances
        self._max_lanes = max_lanes
        self._device = device
        self._place = place
        self._threads = (
            ThreadPoolExecutor(STEP_THREADS, thread_name_prefix="step"),
            ThreadPoolExecutor(ROLLOUT_THREADS, thread_name_prefix="rollout"),
        )
        steps, rollouts = self._threads
        self._live = LiveSessions(
            Threads(steps, STEP_THREADS), Threads(rollouts, ROLLOUT_THREADS), limits=limits, idle_seconds=idle_seconds
        )
        self._compiling = Compiling()
        self._opening = OpeningLocks()
        self._tallies = Tallies()
        self._steps, self._lane_steps, self._expired = Durations(), 0, 0

    async def open(self, request: Open) -> SessionInfo:
        opening = request.opening
        check_size(opening.settings, self._max_lanes)
        digest = digest_of("open", opening)
        async with self._opening.of(request.surrogate_id):
            if opening.key and (known := self._live.opened_by(request.surrogate, opening.key, digest)):
                return info_of(known)
            nbytes = await asyncio.to_thread(self._expected_bytes, request)
            self._live.check_room(nbytes)
            self._tallies.forget_all_but(session.id for session in self._live)
            return info_of(self._live.add(await asyncio.to_thread(self._new_session, request, digest), nbytes))

    async def advance(self, request: Advance) -> Reply:
        if (reply := self.try_now(request)) is not None:
            return reply
        began, steps = time.perf_counter(), steps_asked(request)
        answer = await self._live.advance(
            request.session, request.seq, fingerprint_of(request), self._work(request), steps, self._deadline(request)
        )
        return self._tally(request, answer, began)

    def try_now(self, request: Advance) -> Reply | None:
        if not self._live.prompt(request.session, steps := steps_asked(request)):
            return None
        began = time.perf_counter()
        answer = self._live.advance_now(
            request.session, request.seq, fingerprint_of(request), self._work(request), steps, self._deadline(request)
        )
        return self._tally(request, answer, began)

    async def describe(self, session: str) -> SessionInfo:
        return info_of(self._live.get(session))

    async def coordinates(self, session: str) -> Array:
        with gpu_calls():
            coordinates: Array = self._live.get(session).lanes.q.cpu().numpy()
        return coordinates

    async def submit(self, session: str) -> Visited:
        live = self._live.get(session)
        states = visited_states(live)
        return await asyncio.to_thread(self._visits, live, states)

    async def close(self, session: str) -> None:
        self.end(session)

    def end(self, session: str) -> None:
        """End a session. Does the same as ``close``, but is not a coroutine."""
        self._live.close(session)

    def session(self, id: str) -> Session:
        """Return a session's present state, which is immutable. Raises ``UnknownSession`` or ``SessionExpired``."""
        return self._live.get(id)

    def sessions(self) -> list[Session]:
        """Return the present states of all sessions."""
        return list(self._live)

    async def forget(self, surrogate: int) -> None:
        self._live.close_all_of(surrogate)
        self._models.forget(surrogate)

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        return self._tallies.read(info_of(session) for session in self._live if session.surrogate == surrogate)

    def counts(self) -> Counts:
        sessions = list(self._live)
        return Counts(
            sessions=Counter(session.surrogate for session in sessions),
            lanes=sum(session.settings.num_envs for session in sessions),
            requests=self._live.requests,
            steps=self._steps,
            lane_steps=self._lane_steps,
            expired=self._expired,
        )

    async def sweep(self) -> None:
        self._expired += len(self._live.sweep())
        for surrogate in await asyncio.to_thread(self._models.look):
            await self.forget(surrogate)

    async def start(self) -> None:
        await asyncio.to_thread(self._compiling.start)

    async def stop(self) -> None:
        self._live.stop()
        for threads in self._threads:
            threads.shutdown()
        self._compiling.close()

    async def save(self) -> list[Saved]:
        saved = []
        for session in self._live:
            try:
                saved.append(Saved(session.id, session.surrogate, session_to_bytes(session)))
            except RuntimeError as error:
                if gpu_failure(error) is None:
                    raise
                logger.error("session %s is lost: %s", session.id, error)
        return saved

    async def restore(self, request: Restore) -> None:
        definition = request.definition.on(self._device)
        self._live.add(session_from_bytes(definition, request.saved.data, request.surrogate_id))

    def _work(self, request: Advance) -> Callable[[Session], tuple[Session, Outcome]]:
        return partial(carried_out, request, self._models, partial(self._live.check_wanted, request.session), True)

    def _deadline(self, request: Advance) -> float | None:
        return None if request.within is None else self._live.clock() + request.within

    def _tally(self, request: Advance, answer: Answer, began: float) -> Reply:
        """Return the reply to a request. If the request is not a reset, add its steps and the time since ``began`` to
        the counts. The counts of the session leave out a repeated request; the totals of the engine include it."""
        reply = Reply(answer.seq, answer.outcome)
        tally = self._tallies.of(request.session)
        if isinstance(request, Reset):
            tally.reset(request.mask)
            return reply
        self._steps.observe(time.perf_counter() - began)
        tally.stepped(reply)
        self._lane_steps += steps_of(answer.outcome) * self._live.get(request.session).settings.num_envs
        return reply

    def _expected_bytes(self, request: Open) -> int:
        surrogate, version = request.surrogate_id, request.opening.model
        model = self._models.get(surrogate, self._models.refresh(surrogate) if version == "latest" else version)
        settings = request.opening.settings
        path_size = function_draws(model, settings.functions).path_size
        check_gpu(self._device, request.definition, settings, path_size, model.samples)
        return expected_bytes(request.definition, settings, path_size)

    def _new_session(self, request: Open, digest: str) -> Session:
        definition = request.definition.on(self._device)
        latest = self._models.refresh(request.surrogate_id)
        version = latest if request.opening.model == "latest" else request.opening.model
        model = self._models.get(request.surrogate_id, version, self._device)
        self._compiling.wait()
        with gpu_calls():
            return opened(request, definition, model, version, digest, self._place)

    def _visits(self, session: Session, states: Array) -> Visited:
        surrogate = session.surrogate_id
        version = self._models.latest(surrogate) if session.model == "latest" else session.model
        tolerances, model = self._tolerances(surrogate, version), self._models.get(surrogate, version)
        with plugin_calls(model.definition, interrupts=True):
            return Visited(surrogate, states, visited_confidence(model, states, tolerances))


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
    with gpu_calls():
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


PROGRAM = """
import os
if hasattr(os, "nice"):
    os.nice(10)
import surrogym_server.models.gaussian_process.prediction.compiled.regions
import surrogym_server.models.gaussian_process.prediction.compiled.step
import surrogym_server.virtual.compiled.step
import surrogym_server.virtual.words
"""
PACKAGE = "surrogym_server"
LONGEST_COMPILING = (
    120.0  # the first sessions wait at most this many seconds for the child process, then compile the code too
)


class Compiling:
    """A child process that compiles the numba functions of steps and stores them in a cache on the disk."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the child process, unless numba or the disk cache can't be used, or compiled code is there already."""
        is_cold = compiled.available() and disk_cache.folder(PACKAGE) is not None and not disk_cache.has_any(PACKAGE)
        if self._process is None and is_cold:
            self._process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
            )

    def wait(self) -> None:
        """Wait until the compilation has ended, at most ``LONGEST_COMPILING`` seconds. This blocks, so call it in a
        thread."""
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LONGEST_COMPILING)

    def close(self) -> None:
        """Kill the child process, if it was started."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
