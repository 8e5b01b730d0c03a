"""Checks during a training: whole virtual episodes of the policy, always from the same starts, and the decisions that
follow."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.port import SurrogatePort
from surrogym_trainer.evaluation.imagined import imagined_returns
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.settings import CHECK_EPISODES, TrainSettings

Returns = NDArray[np.float64]

# if the second half of a training cycle gains less than this share of the gain over an untrained network, it counts as
# no gain
GAIN = 0.01
CLEARLY = 2.0  # a mean difference of returns is clear, and not chance, above this number of its standard errors
# a network that gains less than this share of the best episode's gain over an untrained network has learned nothing
LEARNED = 0.01
# a network has learned something only if at least this share of the episodes earns more than with an untrained network;
# fewer may succeed by a lucky posterior sample
MANY = 0.25
# no further gain is possible after this number of checks in a row in which every episode earned the highest return so
# far
SATURATED = 3


class Checks:
    """The best policy of a training so far, by its imagined return, and whether a further gain is likely.

    Args:
        untrained: returns (episodes,) of an untrained network in a check.
        saved: returns of the policy of an earlier training, if there is one. A new network has learned something only
            if it exceeds half of that policy's gain over an untrained network.
    """

    def __init__(self, untrained: Returns, saved: Returns | None = None) -> None:
        self.untrained = float(untrained.mean())
        self.latest: float | None = None  # mean return of the policy in the last check (imagined return)
        self.returns_of_best: Returns | None = None  # (episodes,) returns of the best policy so far
        self._half_way = self.untrained if saved is None else (self.untrained + float(saved.mean())) / 2
        # ``_few``: return that the best quarter of the episodes of an untrained network reach or exceed. ``_many``: the
        # highest such return of all checks so far.
        self._few = self._many = _of_many(untrained)
        self._seen = self.untrained  # highest return of a training episode so far
        self._most = float(untrained.max())  # highest return of an episode of a check so far
        self._full = 0  # number of checks in a row in which every episode had the highest return so far

    @property
    def best(self) -> float | None:
        """Imagined return of the best policy so far."""
        return None if self.returns_of_best is None else float(self.returns_of_best.mean())

    def saw(self, earned: Iterable[float]) -> None:
        """Record the returns of training episodes."""
        self._seen = max([self._seen, *earned])

    def add(self, returns: Returns) -> bool:
        """Record the returns (episodes,) of a check of the current policy. Returns whether this policy is the best so
        far."""
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

        A quarter of the episodes has to earn more than with an untrained network, because under posterior samples of an
        uncertain model a few episodes succeed by chance. If the best quarter of an untrained network leaves no room for
        a gain, as from starts next to the goal, the mean alone decides.
        """
        best, room = self.best, self._seen - self._few
        many = room <= LEARNED * (self._seen - self.untrained) or self._many > self._few + LEARNED * room
        return best is not None and best > max(self._half_way, self._nothing) and many

    @property
    def saturated(self) -> bool:
        """Whether no further gain is possible: in the last ``SATURATED`` checks, every episode earned the highest
        return of all episodes so far."""
        return self._full >= SATURATED

    def gained(self, before: Returns | None) -> bool:
        """Return whether the best policy gains clearly over an earlier one, from the same starts: the mean of the
        paired differences exceeds twice its standard error, and also ``GAIN`` times the best policy's gain over an
        untrained network.

        Args:
            before: returns (episodes,) of the earlier policy; None stands for an untrained network.
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
        """The imagined return up to which a network counts as having learned nothing: that of an untrained network,
        plus a small share of the largest gain so far."""
        return self.untrained + LEARNED * (self._seen - self.untrained)


def checked(port: SurrogatePort, predict: Predict, settings: TrainSettings) -> Returns:
    """Return the returns (episodes,) of a policy in a check: whole virtual episodes, from the same starts in every
    check."""
    return imagined_returns(port, predict, CHECK_EPISODES, settings.seed, **settings.judging)


def _of_many(returns: Returns) -> float:
    """Return the return that the best quarter of the episodes reaches or exceeds."""
    return float(np.quantile(returns, 1 - MANY))
