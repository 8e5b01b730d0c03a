"""Sessions: open, reset, step, roll out, submit occupancy, close; save at shutdown and restore at start."""

from __future__ import annotations

import asyncio
import copy
import logging
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.rollouts import OneStep, parts_of, roll, roll_policy
from surrogym_server.engine.saved import session_from_bytes, session_to_bytes
from surrogym_server.engine.session import (
    Answer,
    Fingerprint,
    Outcome,
    Session,
    WantedVersion,
    digest_of,
    open_session,
    reset_session,
    step_session,
    steps_of,
)
from surrogym_server.engine.sessions import LiveSessions, Work
from surrogym_server.environment.actions import policy_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import Damaged, InvalidInput, NotReset, SurrogymError, TooLarge
from surrogym_server.models.guard import failure_of, plugin_calls
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.uncertainty import visited_confidence
from surrogym_server.services.activity import SessionActivity, Tallies
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import SavedSession
from surrogym_server.tensors import CPU
from surrogym_server.virtual import VirtualSettings, expected_bytes, in_fastest_form, reward_limits
from surrogym_server.virtual.paths import function_draws
from surrogym_shared.acting import PolicyRun
from surrogym_shared.port import StepResult

logger = logging.getLogger(__name__)

Bools = NDArray[np.bool_]
Array = NDArray[np.float64]

SESSION_ID_BYTES = 16
MAX_PARTICLES = 4_000_000  # of all lanes of a session
MAX_PATHWISE_LANES = 4_096  # the function of each is some thousand numbers


@dataclass(frozen=True)
class Opening:
    """What a trainer asks for. A time limit or penalty of None is the surrogate's; a seed of None is drawn."""

    settings: VirtualSettings
    penalty: float | None
    seed: int | None
    model: WantedVersion
    occupancy: bool
    key: str | None


class SessionService:
    def __init__(
        self,
        storage: Storage,
        definitions: Definitions,
        models: ModelCache,
        live: LiveSessions,
        max_lanes: int,
        metrics: ProcessMetrics,
        device: torch.device = CPU,
        compiled: Callable[[], None] = lambda: None,
    ) -> None:
        """
        Args:
            device: where sessions are stepped; what comes in and goes out is not on it.
            compiled: waits until steps that are being compiled are; called in a thread.
        """
        self._storage = storage
        self._definitions = definitions
        self._models = models
        self._live = live
        self._max_lanes = max_lanes
        self._metrics = metrics
        self._device = device
        self._compiled = compiled
        self._tallies = Tallies()
        self._opening = asyncio.Lock()
        self._deadline: float | None = None

    @property
    def idle_seconds(self) -> float:
        return self._live.idle_seconds

    def within(self, seconds: float | None) -> SessionService:
        """This service for one request, that is refused where its answer would take longer from now."""
        if seconds is None:
            return self
        bound = copy.copy(self)
        bound._deadline = self._live.clock() + seconds
        return bound

    async def open(self, surrogate: str, opening: Opening) -> Session:
        """Open a session; the same key and body again give the session they opened.

        Raises:
            UnknownSurrogate, NoModel, UnknownModel, IdempotencyConflict, Overloaded: as the classes say.
            TooLarge: more lanes, particles or memory than the limit.
        """
        self._check_size(opening.settings)
        digest = digest_of("open", opening)
        async with self._opening:
            if opening.key and (known := self._live.opened_by(surrogate, opening.key, digest)):
                return known
            needed = await asyncio.to_thread(self._expected_bytes, surrogate, opening)
            self._live.check_room(needed)
            self._tallies.forget_all_but(self._live)
            return self._live.add(await asyncio.to_thread(self._open, surrogate, opening, digest), needed)

    def get(self, id: str) -> Session:
        """Raises ``UnknownSession`` or ``SessionExpired``."""
        return self._live.get(id)

    def prompt(self, id: str) -> bool:
        """Whether a reset or step of the session would now be carried out without waiting for anything."""
        return self._live.prompt(id)

    def close(self, id: str) -> None:
        """End a session; harmless when it has ended."""
        self._live.close(id)

    async def reset(self, id: str, seq: int | None, seed: int | Sequence[int] | None, mask: Bools | None) -> Answer:
        """New episodes in the lanes of the mask (N,).

        Raises:
            InvalidInput: a mask or a list of seeds of another length than N.
            SeqConflict, UnknownSession, SessionExpired: as the classes say.
        """

        def work(session: Session) -> tuple[Session, Outcome]:
            return reset_session(session, seed, mask, self._latest(session))

        answer = await self._live.advance(id, seq, Fingerprint("reset", seed, mask), work, deadline=self._deadline)
        self._tallies.of(id).reset(mask)
        return answer

    async def step(self, id: str, seq: int | None, action: Array, mask: Bools | None, deviations: bool) -> Answer:
        """One step of the lanes of the mask (N,) with a policy's actions (N, F) or (N,).

        Raises:
            InvalidInput: wrong shape, not finite, out of bounds.
            NotReset: a lane to step has not been reset.
            SeqConflict, UnknownSession, SessionExpired, Overloaded, DeadlineExceeded, PluginFailed: as the classes say.
        """

        def work(session: Session) -> tuple[Session, Outcome]:
            u = policy_actions(session.definition.action, action, session.settings.num_envs)
            stepped, result = self._step(session, u, mask, deviations)
            return stepped, (result,)

        request = Fingerprint("step", _columns(action, 2), mask, deviations)
        return await self._counted(id, seq, request, work, steps=1)

    async def rollout(self, id: str, seq: int | None, actions: Array) -> Answer:
        """T steps with a policy's actions (T, N, F) or (T, N), all or none. Raises as ``step``."""

        def work(session: Session) -> tuple[Session, Outcome]:
            return roll(session, actions, self._stepper(id))

        request = Fingerprint("rollout", _columns(actions, 3))
        return await self._counted(id, seq, request, work, steps=len(actions))

    async def rollout_policy(self, id: str, seq: int | None, run: PolicyRun) -> Answer:
        """Let a policy act in all lanes, all steps or none. Raises as ``step``, and ``TooLarge``."""

        def work(session: Session) -> tuple[Session, Outcome]:
            return roll_policy(session, run, self._stepper(id))

        request = Fingerprint(digest=digest_of("policy", *parts_of(run)))  # at once: its parts would keep the policy
        return await self._counted(id, seq, request, work, run.steps)

    async def submit_occupancy(self, id: str, checkpoint: str) -> tuple[int, float]:
        """Store the states that a session visited under a name; returns how many, and the confidence index there.

        Raises:
            InvalidInput: the session was opened without occupancy.
            NotReset: nothing was visited yet.
            UnknownSurrogate: it was deleted by another server.
        """
        session = self._live.get(id)
        if session.visited is None:
            raise InvalidInput("expected a session opened with occupancy=true, got one without")
        states = session.visited.states
        if not len(states):
            raise NotReset("this session has visited no state yet: reset and step it first")
        return len(states), await asyncio.to_thread(self._submit, session, checkpoint, states)

    def alive(self) -> tuple[int, int]:
        """How many sessions are open, and how many lanes they have."""
        return len(self._live), sum(session.settings.num_envs for session in self._live)

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        """What the open sessions of a surrogate are doing, oldest first. Raises ``UnknownSurrogate``."""
        await asyncio.to_thread(self._storage.surrogates.get, surrogate)
        return self._tallies.read(session for session in self._live if session.surrogate == surrogate)

    @property
    def requests(self) -> int:
        """How many requests that advance a session are at work or waiting."""
        return self._live.requests

    def save(self) -> int:
        """Hand all live sessions to storage; returns how many."""
        saved = [SavedSession(s.id, s.surrogate, session_to_bytes(s)) for s in self._live]
        self._storage.sessions.save(saved)
        return len(saved)

    def restore(self) -> int:
        """Take the saved sessions back; returns how many. The log names each that can't be, and why."""
        try:
            taken = self._storage.sessions.take()
        except Damaged as error:
            logger.error("the saved sessions can't be read, their trainers have to open new ones: %s", error)
            return 0
        return sum(map(self._restored, taken))

    def _restored(self, saved: SavedSession) -> bool:
        try:
            surrogate = self._storage.surrogates.get(saved.surrogate).id
            definition = self._definitions.get(saved.surrogate).on(self._device)
            self._live.add(session_from_bytes(definition, saved.data, surrogate))
        except SurrogymError as error:
            logger.warning("the saved session %s is lost: %s", saved.id, error)
            return False
        return True

    async def _counted(self, id: str, seq: int | None, request: Fingerprint, work: Work, steps: int) -> Answer:
        started = time.perf_counter()
        answer = await self._live.advance(id, seq, request, work, steps, self._deadline)
        self._metrics.steps.observe(time.perf_counter() - started)
        self._tallies.of(id).stepped(answer)
        self._metrics.lane_steps += steps_of(answer.outcome) * self._live.get(id).settings.num_envs
        return answer

    def _check_size(self, settings: VirtualSettings) -> None:
        if settings.num_envs > self._max_lanes:
            raise TooLarge(f"expected at most {self._max_lanes} lanes, got {settings.num_envs}")
        particles = settings.num_envs * settings.particles
        if settings.variant == "probabilistic" and particles > MAX_PARTICLES:
            raise TooLarge(f"expected at most {MAX_PARTICLES} particles in all lanes, got {particles}")
        if settings.variant == "pathwise" and settings.num_envs > MAX_PATHWISE_LANES:
            raise TooLarge(f"expected at most {MAX_PATHWISE_LANES} lanes of variant pathwise, got {settings.num_envs}")

    def _expected_bytes(self, surrogate: str, opening: Opening) -> int:
        id = self._storage.surrogates.get(surrogate).id
        version = self._models.refresh(id) if opening.model == "latest" else opening.model
        model = self._models.get(id, version)
        return expected_bytes(self._definitions.get(surrogate), opening.settings, function_draws(model).path_size)

    def _open(self, surrogate: str, opening: Opening, digest: str) -> Session:
        definition = self._definitions.get(surrogate).on(self._device)
        id = self._storage.surrogates.get(surrogate).id
        latest = self._models.refresh(id)
        version = latest if opening.model == "latest" else opening.model
        model = self._models.get(id, version, self._device)
        self._compiled()
        return open_session(
            secrets.token_urlsafe(SESSION_ID_BYTES),
            surrogate,
            definition,
            in_fastest_form(self._limited(surrogate, resolved(opening, definition), model), model),
            seed=secrets.randbits(63) if opening.seed is None else opening.seed,
            model=opening.model,
            version=version,
            occupancy=opening.occupancy,
            opened_by=None if opening.key is None else (opening.key, digest),
            surrogate_id=id,
        )

    def _limited(self, surrogate: str, settings: VirtualSettings, model: DynamicsModel) -> VirtualSettings:
        """Settings with limits of rewards from the samples. A declared reward is exact and has none. Neither has
        preset ``paper``, nor an imported model that has learned from more than these samples."""
        definition = model.definition
        if definition.declared_reward is not None or not definition.learning.limits_rewards:
            return settings
        seen = self._storage.samples.reward_range(surrogate)
        if seen is None or model.samples > self._storage.samples.count(surrogate):
            return settings
        return replace(settings, reward_limits=reward_limits(*seen))

    def _step(self, session: Session, u: Array, mask: Bools | None, deviations: bool) -> tuple[Session, StepResult]:
        try:
            return step_session(
                session,
                u,
                mask,
                deviations,
                lambda version: self._models.get(session.surrogate_id, version, self._device),
                self._latest(session),
            )
        except SurrogymError:
            raise
        except BaseException as error:  # of a family's code; written out, as ``plugin_calls`` costs each step more
            raise failure_of(session.definition, error) from error

    def _stepper(self, id: str) -> OneStep:
        """Steps of a rollout, which ends where nobody wants it any more."""

        def step(session: Session, u: Array) -> tuple[Session, StepResult]:
            self._live.check_wanted(id)
            return self._step(session, u, None, False)

        return step

    def _submit(self, session: Session, checkpoint: str, states: Array) -> float:
        """Store visited states; the confidence index there. By the id: the name may be another surrogate's by now."""
        name, version = self._storage.surrogates.name_of(session.surrogate_id), self._latest(session)
        tolerances = self._storage.models.get(name, version).tolerances
        model = self._models.get(session.surrogate_id, version)
        with plugin_calls(model.definition, interrupts=True):
            index = visited_confidence(model, states, tolerances)
        self._storage.occupancy.put(name, checkpoint, states)
        return index

    def _latest(self, session: Session) -> int:
        return self._models.latest(session.surrogate_id) if session.model == "latest" else session.model


def _columns(action: Array, dimensions: int) -> Array:
    """Actions with their last axis, that some transports leave out where it has one entry; for the fingerprint."""
    return action[..., None] if action.ndim == dimensions - 1 else action


def resolved(opening: Opening, definition: EnvironmentDefinition) -> VirtualSettings:
    return replace(
        opening.settings,
        time_limit=opening.settings.time_limit or definition.time_limit,
        penalty=definition.penalty if opening.penalty is None else opening.penalty,
    )
