"""What checks of the imagined return say of a training: which policy is kept, when a network is given up, and whether
the training goes on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from surrogym_client.evaluation.imagined import imagined_returns
from surrogym_client.policies.predict import Predict
from surrogym_client.training.settings import CHECK_EPISODES, CHECKS, TrainSettings
from surrogym_shared.port import SurrogatePort

PATIENCE = 0.25  # of the steps, in which a network has to learn something
PROOF = 0.5  # of the steps, in which it has to earn half of what the saved policy earns beyond that
PATIENT_ROLLOUTS = 8  # at least
LATELY = 0.25  # of the steps, the last of them
GAIN = 0.01  # of what the best policy earns beyond an untrained one: a training that gained more lately is not done
SATURATED = 3  # checks in a row in which every episode earned as much as the best one ever did
LEARNED = 0.01  # of what the best virtual episode earned beyond an untrained network: who earns less learned nothing
MANY = 0.25  # of the episodes have to earn that: a few do by the luck of their functions, whatever the policy does


class Imagined(NamedTuple):
    """What a policy earns in the episodes of a check."""

    mean: float
    many: float  # at least, in the best quarter of the episodes


class Verdicts:
    """The checks of one training so far, over all its networks.

    A network that after a quarter of the steps earns no more than an untrained one, but for a hundredth of what some
    episode did, is given up while there is as much left for another: rewards that come at the end alone leave some
    networks without a first success, and they stop exploring before they have one. A quarter of the episodes has to
    earn more: under functions drawn from an unsure model a few reach their end by themselves. Where a quarter of an
    untrained network's episodes earns the most there is, as from starts next to the goal, the mean alone decides.
    Where a saved policy waits, a network has half of the steps to come half as far.

    A training that still gained in its last quarter can take as many steps again, once.

    Args:
        planned: virtual steps of the training.
        untrained: what a network earns that has learned nothing yet.
        saved: what a policy from before earns, for which a network is given up that does not come near it.
    """

    def __init__(self, planned: int, untrained: Imagined, saved: Imagined | None = None) -> None:
        self._planned = planned
        self.total = planned
        self.floor = untrained.mean
        self._half_way = self.floor if saved is None else (self.floor + saved.mean) / 2
        self._few = self._many = untrained.many  # what many episodes earn: of an untrained network, and at best so far
        self._seen = self.floor  # the most that an episode earned, from any start
        self._spent = 0  # by the networks before
        self._now = 0  # by this one
        self._rollouts = 0  # of this one
        self._checked = 0  # checks made
        self._full = 0  # checks in a row that nothing can exceed
        self._bests: list[tuple[int, float]] = []  # steps, and the best imagined return by then
        self.latest: float | None = None
        self.best: float | None = None
        self.given_up = False
        self.networks = 1  # that learned, one after another

    @property
    def steps(self) -> int:
        """Virtual steps taken, by all networks."""
        return self._spent + self._now

    @property
    def own_steps(self) -> int:
        """Those of the network that learns now."""
        return self._now

    @property
    def left(self) -> int:
        return self.total - self.steps

    @property
    def prolonged(self) -> bool:
        return self.total > self._planned

    @property
    def gaining(self) -> bool:
        """Whether the best policy gained in the last quarter of the steps, more than a hundredth of what it earns."""
        if self.best is None or self.best <= self._nothing:
            return False
        before = [best for steps, best in self._bests if steps <= self.total - LATELY * self._planned]
        return self.best - (before[-1] if before else self.floor) > GAIN * (self.best - self.floor)

    @property
    def saturated(self) -> bool:
        """Whether nothing can be gained: in the last checks, no episode earned less than the best one ever did."""
        return self._full >= SATURATED

    def prolong(self) -> bool:
        """Take as many steps again, if that was not done yet and the training still gains."""
        if self.prolonged or not self.gaining:
            return False
        self.total += self._planned
        return True

    def begin(self) -> None:
        """A network begins to learn: the first one, another one, or the same again."""
        if self.given_up:
            self._spent, self._now = self.steps, 0
            self.given_up, self._rollouts = False, 0
            self.networks += 1

    def saw(self, earned: Iterable[float]) -> None:
        """Episodes of the training earned so much."""
        self._seen = max([self._seen, *earned])

    def at(self, steps: int) -> None:
        """This network has taken so many steps."""
        self._now = steps

    def after_rollout(self) -> bool:
        """A rollout ended; whether a check is due."""
        self._rollouts += 1
        return self.steps * CHECKS >= (self._checked + 1) * self._planned

    def check(self, measured: Imagined) -> bool:
        """A check measured the policy as it is; whether that is the best so far."""
        self._checked = int(self.steps * CHECKS / self._planned)
        imagined, self._many = measured.mean, max(self._many, measured.many)
        self.latest = imagined
        best = self.best is None or imagined >= self.best
        self.best = imagined if self.best is None else max(self.best, imagined)
        self._bests.append((self.steps, self.best))
        self._full = self._full + 1 if imagined >= self._seen and imagined > self._nothing else 0
        return best

    def judge(self) -> None:
        """Give this network up, or not."""
        assert self.best is not None
        tried = self._rollouts >= PATIENT_ROLLOUTS and self._now >= PATIENCE * self._planned
        bar = self._half_way if self._now >= PROOF * self._planned else self._nothing
        left = self._planned - self.steps >= PATIENCE * self._planned
        self.given_up = tried and (self.best <= max(bar, self._nothing) or not self._beyond(self._many)) and left

    def knows(self, measured: Imagined) -> tuple[bool, bool]:
        """A policy from before earns so much: whether it is the best so far, and whether it learned anything."""
        imagined = measured.mean
        best = imagined > max(self.floor, self.floor if self.best is None else self.best)
        if best:
            self.best = imagined
        return best, imagined > self._nothing and self._beyond(measured.many)

    def _beyond(self, many: float) -> bool:
        """Whether many episodes earn what an untrained network does not; also where its best quarter leaves nothing to
        earn, so that the mean alone can tell."""
        room = self._seen - self._few
        return room <= LEARNED * (self._seen - self.floor) or many > self._few + LEARNED * room

    @property
    def _nothing(self) -> float:
        """The imagined return up to which nothing was learned."""
        return self.floor + LEARNED * (self._seen - self.floor)


def checked(port: SurrogatePort, predict: Predict, settings: TrainSettings) -> Imagined:
    """What a policy earns as it is now, on the same starts at every check."""
    returns = imagined_returns(port, predict, CHECK_EPISODES, settings.seed, **settings.judging)
    return Imagined(float(returns.mean()), float(np.quantile(returns, 1 - MANY)))
