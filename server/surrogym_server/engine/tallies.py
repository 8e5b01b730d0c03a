"""Counts of an engine's sessions, for the dashboard and the metrics. Only the event loop's thread changes them.

Shapes: N lanes, T steps.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.requests import Reply, SessionInfo
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult

Clock = Callable[[], float]

RATE_SECONDS = 10.0  # time constant in seconds of the exponential moving average of a session's steps per second
KEPT_EPISODES = 100
# Summing the rewards after each step would slow the steps. They are collected, and summed at once when there are
# FOLD_STEPS steps, or FOLD_LANE_STEPS steps times lanes.
FOLD_STEPS, FOLD_LANE_STEPS = 32, 16_384
BUCKETS = (1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)


@dataclass
class Durations:
    """Histogram of durations in seconds, with the upper bounds in ``BUCKETS``, and the sum of the durations."""

    sum: float = 0.0
    _counts: list[int] = field(default_factory=lambda: [0] * (len(BUCKETS) + 1))

    def observe(self, seconds: float) -> None:
        self._counts[bisect_left(BUCKETS, seconds)] += 1
        self.sum += seconds

    def cumulative(self) -> Iterator[tuple[str, int]]:
        """Yield each upper bound in seconds (as text, "+Inf" the last) and the number of durations up to it."""
        total = 0
        for bound, count in zip((*map(str, BUCKETS), "+Inf"), self._counts, strict=True):
            total += count
            yield bound, total

    @classmethod
    def together(cls, parts: Iterable[Durations]) -> Durations:
        """Add up the histograms of several processes."""
        parts = list(parts)
        columns = zip(*(part._counts for part in parts), strict=True)
        return cls(sum(part.sum for part in parts), [sum(column) for column in columns]) if parts else cls()

    def __len__(self) -> int:
        return sum(self._counts)


@dataclass(frozen=True)
class Episode:
    """A finished virtual episode. ``reward`` is the sum of its penalised rewards, and ``penalty`` is the sum of the
    penalties for uncertainty that were subtracted from them."""

    reward: float
    penalty: float


@dataclass(frozen=True)
class SessionActivity:
    """A session, with counts since this process opened or restored it."""

    session: SessionInfo
    steps: int  # number of virtual steps of the session, summed over its lanes
    steps_per_second: float
    episodes: int
    recent: tuple[Episode, ...]  # latest finished episodes of the session, oldest first
    idle_seconds: float  # seconds since the session's last step, or since it was opened if it has taken none


class Tally:
    """Counts of one session: steps, steps per second, and the returns of its latest episodes."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since = self._last = clock()
        self._decayed = 0.0
        self._seq = 0
        self._pending: list[StepResult | PolicyRollout] = []
        self._unfolded = 0  # number of steps in ``_pending``, whose rewards are not summed yet
        # (2, N) sums of the reward and of the penalty for uncertainty in the running episode of each lane; None before
        # the first step.
        self._sums: NDArray[np.float64] | None = None
        self._steps = 0
        self._episodes = 0
        self._recent: deque[Episode] = deque(maxlen=KEPT_EPISODES)

    def stepped(self, answer: Reply) -> None:
        """Add the steps of an answer to the counts, unless it repeats an answer that was counted before."""
        if answer.seq <= self._seq or isinstance(answer.outcome, ResetResult):
            return
        self._seq = answer.seq
        results = (answer.outcome,) if isinstance(answer.outcome, PolicyRollout) else answer.outcome
        now, steps, lanes = self._clock(), len(answer.outcome), results[0].reward.shape[-1]
        self._steps += steps * lanes
        self._decayed = self._decayed * math.exp((self._last - now) / RATE_SECONDS) + steps * lanes
        self._last = now
        self._pending.extend(results)
        self._unfolded += steps
        if self._unfolded >= FOLD_STEPS or self._unfolded * lanes >= FOLD_LANE_STEPS:
            self._fold()

    def reset(self, mask: NDArray[np.bool_] | None) -> None:
        """Discard the sums of the running episodes in the lanes of ``mask`` (N,), because these lanes were reset."""
        self._fold()
        if self._sums is not None:
            self._sums[:, slice(None) if mask is None else mask] = 0.0

    def read(self, session: SessionInfo) -> SessionActivity:
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
        # (T, 2, N) reward and penalty for uncertainty in each of T steps and N lanes.
        gains = np.stack([reward, penalty], 1)
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
    """The counts of all open sessions, by session id."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._tallies: dict[str, Tally] = {}

    def of(self, id: str) -> Tally:
        """Return the counts of a session; they start at zero if the session is new."""
        tally = self._tallies.get(id)
        if tally is None:
            tally = self._tallies[id] = Tally(self._clock)
        return tally

    def read(self, alive: Iterable[SessionInfo]) -> list[SessionActivity]:
        return [self.of(session.id).read(session) for session in alive]

    def forget_all_but(self, alive: Iterable[str]) -> None:
        """Remove the counts of all sessions whose ids are not in ``alive``."""
        ids = set(alive)
        self._tallies = {id: tally for id, tally in self._tallies.items() if id in ids}


@dataclass(frozen=True)
class Counts:
    """Counts of an engine: its open sessions and requests now, and totals since its start."""

    sessions: Mapping[str, int]  # number of open sessions, by the name of the surrogate
    lanes: int  # number of lanes of all open sessions together
    requests: int  # number of requests that run or wait now
    steps: Durations  # durations of all requests for steps, each from its arrival to the reply
    lane_steps: int  # number of virtual steps since the engine's start, summed over all sessions and their lanes
    expired: int  # number of sessions that ended because they were idle for too long
