"""``LocalEngine``: runs sessions in this process, short requests in the event loop and long ones in threads."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import torch

from surrogym_server.engine.compiling import Compiling
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.request_handlers import (
    carried_out,
    check_size,
    fingerprint_of,
    opened,
    steps_asked,
    visited_states,
)
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
    info_of,
)
from surrogym_server.engine.saved import session_from_bytes, session_to_bytes
from surrogym_server.engine.session import Answer, Outcome, Session, digest_of, steps_of
from surrogym_server.engine.sessions import Limits, LiveSessions, OpeningLocks, Threads
from surrogym_server.engine.tallies import Counts, Durations, SessionActivity, Tallies
from surrogym_server.models.draws import function_draws
from surrogym_server.models.guard import plugin_calls
from surrogym_server.sampling.uncertainty import visited_confidence
from surrogym_server.tensors import CPU
from surrogym_server.virtual import expected_bytes

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
        return [Saved(session.id, session.surrogate, session_to_bytes(session)) for session in self._live]

    async def restore(self, request: Restore) -> None:
        definition = request.definition.on(self._device)
        self._live.add(session_from_bytes(definition, request.saved.data, request.surrogate_id))

    def _work(self, request: Advance) -> Callable[[Session], tuple[Session, Outcome]]:
        return partial(carried_out, request, self._models, partial(self._live.check_wanted, request.session), True)

    def _deadline(self, request: Advance) -> float | None:
        return None if request.within is None else self._live.clock() + request.within

    def _tally(self, request: Advance, answer: Answer, began: float) -> Reply:
        """Count the duration since ``began`` and the steps of a request that is not a reset, and return the reply. The
        counts of the session leave out a repeated request; the totals of the engine include it."""
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
        draws = function_draws(model, settings.functions)
        return expected_bytes(request.definition, settings, draws.path_size)

    def _new_session(self, request: Open, digest: str) -> Session:
        definition = request.definition.on(self._device)
        latest = self._models.refresh(request.surrogate_id)
        version = latest if request.opening.model == "latest" else request.opening.model
        model = self._models.get(request.surrogate_id, version, self._device)
        self._compiling.wait()
        return opened(request, definition, model, version, digest, self._place)

    def _visits(self, session: Session, states: Array) -> Visited:
        surrogate = session.surrogate_id
        version = self._models.latest(surrogate) if session.model == "latest" else session.model
        tolerances, model = self._tolerances(surrogate, version), self._models.get(surrogate, version)
        with plugin_calls(model.definition, interrupts=True):
            return Visited(surrogate, states, visited_confidence(model, states, tolerances))
