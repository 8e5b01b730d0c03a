"""A Pendulum with exact dynamics, twice: as a SurrogatePort without a server, and as a Gymnasium environment.

Both draw the same starts from a seed and step by the same arithmetic, so that whatever differs between
two environment classes built on them is the classes' doing. Fast spinning terminates an episode, unlike
Gymnasium's Pendulum, so that episodes end in both ways and at different times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from surrogym_client.errors import refused_here
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.codes import Code
from surrogym_shared.port import ResetResult, StepResult
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import BoxSpace, OpenSession, SessionView, SubmittedOccupancy

TIME_LIMIT = 12
SPINNING = 4.0
HIGH = [1.0, 1.0, 8.0]


@dataclass
class Pendulum:
    """One pendulum; an episode's start follows from (seed, lane, episode)."""

    seed: int
    lane: int = 0
    time_limit: int = TIME_LIMIT
    episode: int = -1
    steps: int = 0
    angle: float = 0.0
    speed: float = 0.0
    running: bool = False

    @property
    def version(self) -> int:
        """The model the episode runs under: every episode has a newer one."""
        return self.episode + 1

    def reset(self) -> np.ndarray:
        self.episode += 1
        self.steps, self.running = 0, True
        draw = np.random.default_rng([self.seed, self.lane, self.episode])
        self.angle, self.speed = draw.uniform(-math.pi, math.pi), draw.uniform(-1, 1)
        return self.observation()

    def step(self, torque: float) -> tuple[np.ndarray, float, bool, bool]:
        wrapped = (self.angle + math.pi) % (2 * math.pi) - math.pi
        reward = -(wrapped**2 + 0.1 * self.speed**2 + 0.001 * torque**2)
        self.speed += (15 * math.sin(self.angle) + 3 * torque) * 0.05
        self.angle += self.speed * 0.05
        self.steps += 1
        terminated = abs(self.speed) > SPINNING
        truncated = self.steps >= self.time_limit
        self.running = not (terminated or truncated)
        return self.observation(), reward, terminated, truncated

    def observation(self) -> np.ndarray:
        return np.array([math.cos(self.angle), math.sin(self.angle), self.speed], dtype=np.float32)


class ExactEnv(gymnasium.Env):
    """The pendulum as Gymnasium's own vector environments take it, with the infos of ``RemoteEnv``."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.float32(HIGH), np.float32(HIGH))
        self.action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
        self.pendulum = Pendulum(seed=0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        if seed is not None:
            self.pendulum = Pendulum(seed=seed)
        return self.pendulum.reset(), {"model_version": self.pendulum.version}

    def step(self, action: np.ndarray):
        observation, reward, terminated, truncated = self.pendulum.step(float(action[0]))
        info = {"model_version": self.pendulum.version, "reward_mean": reward}
        return observation, reward, terminated, truncated, info


@dataclass
class Session:
    request: OpenSession
    lanes: list[Pendulum]
    over: np.ndarray  # (N,) ended in the last step, for next_step


@dataclass
class ExactPendulum:
    """The port. ``lose()`` forgets every session, as a crash does; requests are counted."""

    sessions: dict[str, Session] = field(default_factory=dict)
    opened: list[OpenSession] = field(default_factory=list)
    requests: int = 0

    def lose(self) -> None:
        self.sessions.clear()

    def spec(self) -> EnvironmentSpec:
        return pendulum()

    def open(self, request: OpenSession) -> SessionView:
        self.opened.append(request)
        seed = 77 if request.seed is None else request.seed
        identity = f"s{len(self.opened)}"
        lanes = [Pendulum(seed, i, request.time_limit or TIME_LIMIT) for i in range(request.num_envs)]
        self.sessions[identity] = Session(request, lanes, np.zeros(request.num_envs, dtype=bool))
        return SessionView(
            id=identity,
            surrogate="pendulum",
            num_envs=request.num_envs,
            variant=request.variant,
            seed=seed,
            autoreset_mode=request.autoreset_mode,
            model="latest",
            model_version=[1] * request.num_envs,
            seq=0,
            time_limit=request.time_limit or TIME_LIMIT,
            penalty=0.0,
            observation_space=BoxSpace(low=[-h for h in HIGH], high=HIGH),
            action_space=BoxSpace(low=[-2.0], high=[2.0]),
            outputs=["angle", "velocity", "reward"],
            idle_seconds=60.0,
        )

    def reset(
        self, session: str, *, seed: int | Sequence[int] | None = None, mask: np.ndarray | None = None
    ) -> ResetResult:
        found = self._session(session)
        for i, lane in enumerate(found.lanes):
            if mask is not None and not mask[i]:
                continue
            if seed is not None:
                key = (seed, i) if isinstance(seed, int) else (seed[i], 0)
                found.lanes[i] = lane = Pendulum(*key, lane.time_limit)
            lane.reset()
            found.over[i] = False
        return ResetResult(np.stack([lane.observation() for lane in found.lanes]), self._versions(found))

    def step(
        self, session: str, action: np.ndarray, *, mask: np.ndarray | None = None, deviations: bool = False
    ) -> StepResult:
        found, n = self._session(session), len(self._session(session).lanes)
        observation = np.stack([lane.observation() for lane in found.lanes])
        reward, terminated, truncated = np.zeros(n), np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        final: dict[int, np.ndarray] = {}
        mode = found.request.autoreset_mode
        for i in range(n) if mask is None else np.flatnonzero(mask):
            if mode == "next_step" and found.over[i]:
                observation[i] = found.lanes[i].reset()
                continue
            if not found.lanes[i].running:
                raise refused_here(Code.NOT_RESET, f"lane {i} has to be reset")
            observation[i], reward[i], terminated[i], truncated[i] = found.lanes[i].step(float(action[i][0]))
            if mode == "same_step" and not found.lanes[i].running:
                final[int(i)] = observation[i].copy()
                observation[i] = found.lanes[i].reset()
        stepped = np.ones(n, dtype=bool) if mask is None else mask
        found.over = np.where(stepped, terminated | truncated, found.over)
        return StepResult(
            observation=observation,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_lanes=np.array(list(final), dtype=np.int64),
            final_observation=np.array(list(final.values()), dtype=np.float32).reshape(-1, 3),
            model_version=self._versions(found),
            reward_mean=reward.copy(),
            deviation=np.full((n, 3), 0.5) if deviations else None,
        )

    def rollout(self, session: str, actions: np.ndarray) -> list[StepResult]:
        return [self.step(session, action) for action in actions]

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        return SubmittedOccupancy(checkpoint=checkpoint, states=len(self._session(session).lanes))

    def close(self, session: str) -> None:
        self.sessions.pop(session, None)

    def _session(self, session: str) -> Session:
        self.requests += 1
        if session not in self.sessions:
            raise refused_here(Code.SESSION_EXPIRED, f"session {session} was lost with a crash")
        return self.sessions[session]

    @staticmethod
    def _versions(session: Session) -> np.ndarray:
        return np.array([lane.version for lane in session.lanes], dtype=np.int64)
