"""Decisions from checks of the imagined return: which policy to keep, when to abandon a network, and when to stop."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from surrogym_shared.port import SurrogatePort
from surrogym_trainer.evaluation.imagined import imagined_returns
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.settings import CHECK_EPISODES, CHECKS, TrainSettings

PATIENCE = 0.25  # share of the steps within which a network has to learn something
PROOF = 0.5  # share of the steps within which it has to reach half of the saved policy's gain
PATIENT_ROLLOUTS = 8  # fewest rollouts before a network is abandoned
LATELY = 0.25  # share of the steps, at the end, in which a gain counts as recent
GAIN = 0.0025  # share of the best policy's gain over an untrained one: a larger recent gain prolongs the training
SATURATED = 3  # checks in a row in which every episode earned as much as the best one ever did
LEARNED = 0.01  # share of the best episode's gain over an untrained network: below, nothing was learned
MANY = 0.25  # share of the episodes that has to earn this: a few do by luck of their drawn functions


class Imagined(NamedTuple):
    """Returns of a policy in the virtual episodes of a check."""

    mean: float
    many: float  # lowest return in the best quarter of the episodes
    most: float  # highest return of an episode


class Verdicts:
    """Checks of one training so far, over all its networks, and the decisions that follow from them.

    A network is abandoned if, after a quarter of the steps, it has gained less than 1 % of the best episode's gain over
    an untrained network, and if a quarter of the steps remains for another one. The reason: with rewards only at the
    end, some networks never have a first success, and stop exploring before. A quarter of the episodes has to show the
    gain, because under functions drawn from an uncertain model a few episodes succeed by themselves. The mean alone
    decides if a quarter of an untrained network's episodes already earns the most, as from starts next to the goal. If
    there is a saved policy, a network has half of the steps to reach half of its gain.

    A training that still gained in its last quarter can take as many steps again, once.

    Args:
        planned: virtual steps of the training.
        untrained: returns of a network that has learned nothing yet.
        saved: returns of a policy of an earlier training; a network that does not come near it is abandoned.
        patient: whether no network is abandoned.
    """

    def __init__(
        self, planned: int, untrained: Imagined, saved: Imagined | None = None, *, patient: bool = False
    ) -> None:
        self._planned = planned
        self._patient = patient
        self.total = planned
        self.floor = untrained.mean
        self._half_way = self.floor if saved is None else (self.floor + saved.mean) / 2
        self._few = self._many = untrained.many  # return of many episodes: of an untrained network, and the best so far
        self._seen = self.floor  # largest return of an episode of the training so far, from any start
        self._most = untrained.most  # largest return of an episode of a check so far
        self._spent = 0  # steps of earlier networks
        self._now = 0  # steps of this network
        self._rollouts = 0  # rollouts of this network
        self._checked = 0  # checks made
        self._full = 0  # checks in a row whose returns nothing can exceed
        self._bests: list[tuple[int, float]] = []  # steps, and the best imagined return by then
        self.latest: float | None = None
        self.best: float | None = None
        self.given_up = False
        self.networks = 1  # networks so far, of which all but the last were abandoned

    @property
    def steps(self) -> int:
        """Virtual steps taken, by all networks."""
        return self._spent + self._now

    @property
    def own_steps(self) -> int:
        """Virtual steps of the present network."""
        return self._now

    @property
    def left(self) -> int:
        return self.total - self.steps

    @property
    def prolonged(self) -> bool:
        return self.total > self._planned

    @property
    def gaining(self) -> bool:
        """Whether the best policy improved in the last quarter of the steps by more than ``GAIN`` of its gain."""
        if self.best is None or self.best <= self._nothing:
            return False
        before = [best for steps, best in self._bests if steps <= self.total - LATELY * self._planned]
        return self.best - (before[-1] if before else self.floor) > GAIN * (self.best - self.floor)

    @property
    def saturated(self) -> bool:
        """Whether no further gain is possible: in the last checks, each episode's return equalled the best one so
        far, of the training and of all checks, and none of them was a gain."""
        return self._full >= SATURATED

    def prolong(self) -> bool:
        """Take as many steps again, if that has not happened yet and the training still gains."""
        if self.prolonged or not self.gaining:
            return False
        self.extend()
        return True

    def extend(self) -> None:
        """Take as many steps again as were planned."""
        self.total += self._planned

    def begin(self) -> None:
        """Record that a network begins to learn: the first one, another one, or the same one again."""
        if self.given_up:
            self.restart()
            self.networks += 1

    def restart(self) -> None:
        """Record that a new network begins to learn."""
        self._spent, self._now = self.steps, 0
        self.given_up, self._rollouts = False, 0

    def saw(self, earned: Iterable[float]) -> None:
        """Record the returns of training episodes."""
        self._seen = max([self._seen, *earned])

    def at(self, steps: int) -> None:
        """Record the number of steps of the present network."""
        self._now = steps

    def after_rollout(self) -> bool:
        """Record the end of a rollout. Returns whether a check is due."""
        self._rollouts += 1
        return self.steps * CHECKS >= (self._checked + 1) * self._planned

    def check(self, measured: Imagined) -> bool:
        """Record a check of the present policy. Returns whether it is the best so far."""
        self._checked = int(self.steps * CHECKS / self._planned)
        imagined, self._many = measured.mean, max(self._many, measured.many)
        rose, self._most = measured.most > self._most, max(self._most, measured.most)
        self.latest = imagined
        best = self.best is None or imagined >= self.best
        self.best = imagined if self.best is None else max(self.best, imagined)
        self._bests.append((self.steps, self.best))
        full = imagined >= max(self._seen, self._most) and imagined > self._nothing
        self._full = (1 if rose else self._full + 1) if full else 0
        return best

    def judge(self) -> None:
        """Decide whether to abandon the present network, and set ``given_up``."""
        assert self.best is not None
        tried = self._rollouts >= PATIENT_ROLLOUTS and self._now >= PATIENCE * self._planned and not self._patient
        bar = self._half_way if self._now >= PROOF * self._planned else self._nothing
        left = self._planned - self.steps >= PATIENCE * self._planned
        self.given_up = tried and (self.best <= max(bar, self._nothing) or not self._beyond(self._many)) and left

    def knows(self, measured: Imagined) -> tuple[bool, bool]:
        """Record the returns of an earlier policy. Returns whether it is the best so far, and whether it had learned
        anything."""
        imagined = measured.mean
        best = imagined > max(self.floor, self.floor if self.best is None else self.best)
        if best:
            self.best = imagined
        return best, imagined > self._nothing and self._beyond(measured.many)

    def _beyond(self, many: float) -> bool:
        """Whether ``many``, the return that many episodes reach, exceeds that of an untrained network.

        Also True if an untrained network's best quarter of episodes leaves no room for a gain. The mean then decides.
        """
        room = self._seen - self._few
        return room <= LEARNED * (self._seen - self.floor) or many > self._few + LEARNED * room

    @property
    def _nothing(self) -> float:
        """Imagined return up to which a network counts as having learned nothing."""
        return self.floor + LEARNED * (self._seen - self.floor)


def checked(port: SurrogatePort, predict: Predict, settings: TrainSettings) -> Imagined:
    """Measure the present policy's returns, on the same starts at every check."""
    returns = imagined_returns(port, predict, CHECK_EPISODES, settings.seed, **settings.judging)
    return Imagined(float(returns.mean()), float(np.quantile(returns, 1 - MANY)), float(returns.max()))
