"""The port of a peer: an original environment whose steps are counted, and a policy after each round.

Shapes: C coordinates, D observation entries, F action entries.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Protocol

import numpy as np

from surrogym_client.errors import SurrogymClientError
from surrogym_lab.original_port import SEEDS
from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.protocol import LONGEST_EPISODE, Array
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies.predict import Acting


class NotApplicable(SurrogymClientError):
    """A peer can't learn a task; the message says why."""


class BudgetSpent(Exception):
    """The real steps of a cell are spent. Raised by ``Real.step``, for the study."""


class OutOfTime(Exception):
    """The processor time of a cell is spent. Raised by ``Clock.check``, for the study."""


class Clock:
    """Processor seconds of learning, without pauses for evaluations."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._started = time.process_time()
        self._paused = 0.0

    @property
    def seconds(self) -> float:
        return time.process_time() - self._started - self._paused

    def check(self) -> None:
        """Raise ``OutOfTime`` if the limit has passed. Long optimisations call it between iterations."""
        if self.seconds > self._limit:
            raise OutOfTime

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Don't count what happens inside."""
        began = time.process_time()
        yield
        self._paused += time.process_time() - began


class Real:
    """The original environment as a peer gets it: it can be reset and stepped, and each step counts.

    Attributes:
        spec: its specification.
        budget: the largest number of real steps.
        steps: real steps so far.
        clock: processor time of the cell.
    """

    def __init__(
        self, spec: EnvironmentSpec, open_episode: Callable[[], Episode], seed: int, budget: int, clock: Clock
    ) -> None:
        self.spec = spec
        self.budget = budget
        self.steps = 0
        self.clock = clock
        self._episode = open_episode()
        self._seeds = np.random.default_rng(seed)
        self._limit = spec.time_limit or LONGEST_EPISODE
        self._length = 0

    @property
    def left(self) -> int:
        """Real steps that are left."""
        return self.budget - self.steps

    def reset(self) -> Moment:
        """Begin an episode at a start of the task. Its seed is none of an evaluation."""
        self._length = 0
        return self._episode.reset(int(self._seeds.integers(*SEEDS)))

    def step(self, action: Array) -> Moment:
        """Take one real step with an action (F,) of the environment. The time limit truncates.

        Raises:
            BudgetSpent: no real step is left.
            OutOfTime: no processor time is left.
        """
        self.clock.check()
        if self.left < 1:
            raise BudgetSpent
        moment = self._episode.step(action)
        self.steps += 1
        self._length += 1
        over = self._length >= self._limit and not moment.terminated
        return replace(moment, truncated=moment.truncated or over)

    def close(self) -> None:
        self._episode.close()


class Peer(Protocol):
    """A method that learns in the original environment."""

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Learn, and yield the policy after each round. ``real`` ends the cell by its errors; a peer need not catch
        them.

        Raises:
            NotApplicable: the method can't learn this task.
        """
        ...
