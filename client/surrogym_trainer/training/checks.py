"""Checks of a training: whole virtual episodes of a policy, from the same starts each time, and what they decide."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.port import SurrogatePort
from surrogym_trainer.evaluation.imagined import imagined_returns
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.settings import CHECK_EPISODES, TrainSettings

Returns = NDArray[np.float64]

GAIN = 0.01  # of the second half of a cycle: a smaller share of the gain over an untrained network is none
CLEARLY = 2.0  # standard errors
LEARNED = 0.01  # share of the best episode's gain over an untrained network: below, nothing was learned
MANY = 0.25  # share of the episodes that has to earn this: a few do by luck of their posterior samples
SATURATED = 3  # checks in a row in which every episode earned as much as the best one ever did


class Checks:
    """The best policy of a training so far, by its imagined return, and whether a further gain is likely.

    Args:
        untrained: returns of a network that has learned nothing yet.
        saved: returns of the policy of an earlier training. A new network has learned something if it reaches half of
            that policy's gain.
    """

    def __init__(self, untrained: Returns, saved: Returns | None = None) -> None:
        self.untrained = float(untrained.mean())
        self.latest: float | None = None  # imagined return of the last check
        self.returns_of_best: Returns | None = None  # (episodes,) of the best policy so far
        self._half_way = self.untrained if saved is None else (self.untrained + float(saved.mean())) / 2
        self._few = self._many = _of_many(untrained)  # of an untrained network, and the highest so far
        self._seen = self.untrained  # highest return of a training episode
        self._most = float(untrained.max())  # highest return of an episode of a check
        self._full = 0  # checks in a row whose returns nothing can exceed

    @property
    def best(self) -> float | None:
        """Imagined return of the best policy so far."""
        return None if self.returns_of_best is None else float(self.returns_of_best.mean())

    def saw(self, earned: Iterable[float]) -> None:
        """Record the returns of training episodes."""
        self._seen = max([self._seen, *earned])

    def add(self, returns: Returns) -> bool:
        """Record a check of the present policy. Returns whether it is the best so far."""
        imagined, most = float(returns.mean()), float(returns.max())
        self._many = max(self._many, _of_many(returns))
        rose, self._most = most > self._most, max(self._most, most)
        full = imagined >= max(self._seen, self._most) and imagined > self._nothing
        self._full = (1 if rose else self._full + 1) if full else 0
        self.latest = imagined
        better = self.best is None or imagined >= self.best
        if better:
            self.returns_of_best = returns
        return better

    @property
    def learned(self) -> bool:
        """Whether the best policy has learned something.

        A quarter of the episodes has to earn more than with an untrained network. Under posterior samples of an
        uncertain model a few episodes succeed by themselves. Where the best quarter leaves no room for a gain, as from
        starts next to the goal, the mean alone decides.
        """
        best, room = self.best, self._seen - self._few
        many = room <= LEARNED * (self._seen - self.untrained) or self._many > self._few + LEARNED * room
        return best is not None and best > max(self._half_way, self._nothing) and many

    @property
    def saturated(self) -> bool:
        """Whether no further gain is possible: in the last checks, each episode's return equalled the highest one so
        far, of the training and of all checks."""
        return self._full >= SATURATED

    def gained(self, before: Returns | None) -> bool:
        """Whether the best policy gains clearly over an earlier one, from the same starts: the mean of the paired
        differences exceeds twice its standard error, and ``GAIN`` of the gain over an untrained network.

        Args:
            before: returns (episodes,) of the best policy before; None: of an untrained network.
        """
        best = self.returns_of_best
        if best is None or not self.learned:
            return False
        if before is None:
            return True
        gains = best - before
        error = float(gains.std(ddof=1)) / len(gains) ** 0.5
        return bool(gains.mean() > max(CLEARLY * error, GAIN * (best.mean() - self.untrained)))

    @property
    def _nothing(self) -> float:
        """Imagined return up to which a network counts as having learned nothing."""
        return self.untrained + LEARNED * (self._seen - self.untrained)


def checked(port: SurrogatePort, predict: Predict, settings: TrainSettings) -> Returns:
    """Return the returns of a policy's check."""
    return imagined_returns(port, predict, CHECK_EPISODES, settings.seed, **settings.judging)


def _of_many(returns: Returns) -> float:
    """Return the lowest return of the best quarter of the episodes."""
    return float(np.quantile(returns, 1 - MANY))
