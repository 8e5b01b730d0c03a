"""Episodes of a policy that keep declared limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.limits.guard import Guard, Watchdog
from surrogym_sampler.original.limits.programs import program_of
from surrogym_sampler.original.protocol import Array


class GuardedEpisode(Episode):
    """An episode that keeps the limits of its specification. The declared fallback controller acts in the place of the
    policy shortly before a limit would be left, and when no action comes for a sampling period."""

    def __init__(self, episode: Episode, fallback: str | None = None) -> None:
        super().__init__(episode.spec)
        self.parallel = episode.parallel
        self._episode = episode
        self._guard = Guard(episode.spec, program_of(episode.spec, fallback))
        self._watchdog = Watchdog(episode.spec, self._guard, self._fall, waits=self.parallel)

    def reset(self, seed: int) -> Moment:
        with self._watchdog:
            return self._started(self._episode.reset(seed))

    def place(self, coordinates: Array) -> Moment:
        with self._watchdog:
            return self._started(self._episode.place(coordinates))

    def step(self, action: Array) -> Moment:
        """Apply the action (F,), or the fallback controller's shortly before a limit would be left. In that case,
        ``fell_back`` of the result is true and ``applied`` is the applied action.

        Raises:
            StepFailed: the watchdog has ended the episode.
        """
        with self._watchdog:
            self._watchdog.check()
            self._watchdog.running()
            chosen, fallen = self._guard.choose(action)
            moment = self._episode.step(chosen)
            self._guard.reached(moment.coordinates)
            if moment.terminated or moment.truncated:
                self._watchdog.over()
            else:
                self._watchdog.running()
            applied = chosen if moment.applied is None else moment.applied
            return replace(moment, applied=applied, fell_back=True) if fallen else moment

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        self._episode.perturb(rng, sigma)

    def close(self) -> None:
        try:
            self._watchdog.close("the episode's environment is closed")
        finally:
            self._episode.close()

    def _started(self, moment: Moment) -> Moment:
        self._guard.begin(moment.coordinates)
        self._watchdog.reset()
        return moment

    def _fall(self, action: Array) -> bool:
        self._episode.resume(self._guard.at)
        moment = self._episode.step(action)
        self._guard.reached(moment.coordinates)
        return not (moment.terminated or moment.truncated)
