"""What sessions and samplers are doing, for people to look at. Kept in memory, written in the event loop's thread.

Shapes: N lanes, T steps.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.session import Answer, Session
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult

Clock = Callable[[], float]

RATE_SECONDS = 10.0  # steps per second are an exponential average over about so long
KEPT_EPISODES = 100
FOLD_STEPS = 32  # as many are gathered before they are summed: the path of a step is short
FOLD_LANE_STEPS = 16_384  # or as many of all lanes
ALIVE_SECONDS = 60.0  # a sampler that was not heard of for so long is taken for gone


@dataclass(frozen=True)
class Episode:
    """One that ended. ``reward`` is the imagined return, ``penalty`` what was taken off it for its deviations."""

    reward: float
    penalty: float


@dataclass(frozen=True)
class SessionActivity:
    """A session and what it did since this process knows it."""

    session: Session
    steps: int  # of all lanes
    steps_per_second: float
    episodes: int
    recent: tuple[Episode, ...]  # the last ones, oldest first
    idle_seconds: float  # since its last step


class Tally:
    """Sums of one session's steps."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since = self._last = clock()
        self._decayed = 0.0
        self._seq = 0
        self._pending: list[StepResult | PolicyRollout] = []
        self._unfolded = 0  # steps in them
        self._sums: NDArray[np.float64] | None = None  # (2, N) reward and penalty of the running episodes
        self._steps = 0
        self._episodes = 0
        self._recent: deque[Episode] = deque(maxlen=KEPT_EPISODES)

    def stepped(self, answer: Answer) -> None:
        """Take note of an answer; one that was given before counts once."""
        if answer.seq <= self._seq or isinstance(answer.outcome, ResetResult):
            return
        self._seq = answer.seq
        results = (answer.outcome,) if isinstance(answer.outcome, PolicyRollout) else answer.outcome
        now, taken, lanes = self._clock(), len(answer.outcome), results[0].reward.shape[-1]
        self._steps += taken * lanes
        self._decayed = self._decayed * math.exp((self._last - now) / RATE_SECONDS) + taken * lanes
        self._last = now
        self._pending.extend(results)
        self._unfolded += taken
        if self._unfolded >= FOLD_STEPS or self._unfolded * lanes >= FOLD_LANE_STEPS:
            self._fold()

    def reset(self, mask: NDArray[np.bool_] | None) -> None:
        """Episodes of the lanes of the mask (N,) ended without an end: their returns count for nothing."""
        self._fold()
        if self._sums is not None:
            self._sums[:, slice(None) if mask is None else mask] = 0.0

    def read(self, session: Session) -> SessionActivity:
        self._fold()
        now = self._clock()
        seconds = RATE_SECONDS * -math.expm1((self._since - now) / RATE_SECONDS)
        decayed = self._decayed * math.exp((self._last - now) / RATE_SECONDS)
        return SessionActivity(
            session=session,
            steps=self._steps,
            steps_per_second=decayed / seconds if seconds > 0 else 0.0,
            episodes=self._episodes,
            recent=tuple(self._recent),
            idle_seconds=now - self._last,
        )

    def _fold(self) -> None:
        if not self._pending:
            return
        reward = np.concatenate([np.atleast_2d(result.reward) for result in self._pending])
        penalty = np.concatenate([np.atleast_2d(result.reward_mean) for result in self._pending]) - reward
        ended = np.concatenate([np.atleast_2d(result.terminated | result.truncated) for result in self._pending])
        self._pending.clear()
        self._unfolded = 0
        gains = np.stack([reward, penalty], 1)  # (T, 2, N)
        sums = np.zeros(gains.shape[1:]) if self._sums is None else self._sums
        begin = 0
        for step in np.flatnonzero(ended.any(1)).tolist():
            sums = sums + gains[begin : step + 1].sum(0)
            lanes = ended[step]
            self._episodes += int(lanes.sum())
            self._recent.extend(Episode(*map(float, column)) for column in sums[:, lanes].T)
            sums[:, lanes] = 0.0
            begin = step + 1
        self._sums = sums + gains[begin:].sum(0)


class Tallies:
    """A tally for each session that is alive."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._tallies: dict[str, Tally] = {}

    def of(self, id: str) -> Tally:
        """The tally of a session; a new one where it has none."""
        tally = self._tallies.get(id)
        if tally is None:
            tally = self._tallies[id] = Tally(self._clock)
        return tally

    def read(self, alive: Iterable[Session]) -> list[SessionActivity]:
        return [self.of(session.id).read(session) for session in alive]

    def forget_all_but(self, alive: Iterable[Session]) -> None:
        ids = {session.id for session in alive}
        self._tallies = {id: tally for id, tally in self._tallies.items() if id in ids}


class Samplers:
    """When each sampler was last heard of. May be called from any thread."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._heard: dict[tuple[str, str], float] = {}

    def heard(self, surrogate: str, sampler: str) -> None:
        now = self._clock()
        fresh = {key: at for key, at in self._heard.copy().items() if now - at < ALIVE_SECONDS}
        self._heard = fresh | {(surrogate, sampler): now}

    def by_surrogate(self) -> dict[str, list[str]]:
        """Names of those that asked or answered within the last minute."""
        now, alive = self._clock(), defaultdict[str, list[str]](list)
        for (surrogate, sampler), at in sorted(self._heard.items()):
            if now - at < ALIVE_SECONDS:
                alive[surrogate].append(sampler)
        return alive
