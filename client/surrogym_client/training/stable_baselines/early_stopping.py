"""Checks of a training by imagined return: the best policy is kept, a network that learns nothing is given up, and a
training goes on while it gains."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from surrogym_client.training.settings import CHECKS, TrainProgress

PATIENCE = 0.25  # of the steps, in which a network has to learn something
PROOF = 0.5  # of the steps, in which it has to earn half of what the saved policy earns beyond that
PATIENT_ROLLOUTS = 8  # at least
LATELY = 0.25  # of the steps, the last of them
GAIN = 0.01  # of what the best policy earns beyond an untrained one: a training that gained more lately is not done
LEARNED = 0.01  # of what the best virtual episode earned beyond an untrained network: who earns less learned nothing


class Checks(BaseCallback):
    """Measures the imagined return of what is learned, reports progress, and what the penalty took of the reward.

    A network that after a quarter of the steps earns no more than an untrained one, but for a hundredth of what some
    episode did, is given up while there is as much left for another: rewards that come at the end alone leave some
    networks without a first success, and they stop exploring before they have one. Where a saved policy waits, a
    network has half of the steps to come half as far.

    A training that still gained in its last quarter can take as many steps again, once.

    Args:
        total: virtual steps of the training.
        progress: called after every rollout.
        imagine: a learner's imagined return.
        untrained: a learner that has learned nothing yet.
        saved: a policy from before, for which a network is given up that does not come near it.
    """

    def __init__(
        self,
        total: int,
        progress: Callable[[TrainProgress], None] | None,
        imagine: Callable[[BaseAlgorithm], float],
        untrained: BaseAlgorithm,
        saved: BaseAlgorithm | None = None,
    ) -> None:
        super().__init__()
        self._planned = total
        self._total = total
        self._progress = progress
        self._imagine = imagine
        self._floor = imagine(untrained)
        self._half_way = self._floor if saved is None else (self._floor + imagine(saved)) / 2
        self._seen = self._floor  # the most that an episode earned, from any start
        self._spent = 0  # by the networks before
        self._rollouts = 0  # of this one
        self._checked = 0  # checks made
        self._bests: list[tuple[int, float]] = []  # steps, and the best imagined return by then
        self._latest: float | None = None
        self._kept: tuple[BaseAlgorithm, dict[str, Any]] | None = None  # whose, and its parameters then
        self._penalty = self._size = 0.0
        self._penalties: deque[float] = deque(maxlen=100)  # of the last episodes
        self.best: float | None = None
        self.given_up = False
        self.networks = 1  # that learned, one after another
        self.lost = 0

    @property
    def steps(self) -> int:
        """Virtual steps taken, by all networks."""
        return self._spent + self.num_timesteps

    @property
    def left(self) -> int:
        return self._total - self.steps

    @property
    def prolonged(self) -> bool:
        return self._total > self._planned

    def prolong(self) -> bool:
        """Take as many steps again, if that was not done yet and the training still gains."""
        if self.prolonged or not self.gaining:
            return False
        self._total += self._planned
        return True

    @property
    def gaining(self) -> bool:
        """Whether the best policy gained in the last quarter of the steps, more than a hundredth of what it earns."""
        if self.best is None or self.best <= self._nothing:
            return False
        before = [best for steps, best in self._bests if steps <= self._total - LATELY * self._planned]
        return self.best - (before[-1] if before else self._floor) > GAIN * (self.best - self._floor)

    @property
    def episode_penalty(self) -> float | None:
        return float(np.mean(self._penalties)) if self._penalties else None

    def worth_keeping(self, known: BaseAlgorithm) -> bool:
        """Whether a policy from before learned anything; it is kept as the best so far if it is."""
        earned = self._imagine(known)
        if earned > max(self._floor, self._floor if self.best is None else self.best):
            self._keep(earned, known)
        return earned > self._nothing

    def best_of(self, last: BaseAlgorithm) -> BaseAlgorithm:
        """The learner that had the best imagined return of all checks, with its policy of then; without any check the
        last one."""
        if self._kept is None:
            return last
        learner, parameters = self._kept
        learner.policy.load_state_dict(parameters)
        return learner

    @property
    def _nothing(self) -> float:
        """The imagined return up to which nothing was learned."""
        return self._floor + LEARNED * (self._seen - self._floor)

    def _on_training_start(self) -> None:
        if self.given_up:
            self.given_up, self._rollouts = False, 0
            self.networks += 1

    def _on_step(self) -> bool:
        infos, env = self.locals["infos"], self.training_env
        assert isinstance(env, VecNormalize)
        reward = env.get_original_reward()
        mean = np.array([info["reward_mean"] for info in infos])
        self._penalty += float(np.abs(mean - reward).sum())
        self._size += float(np.abs(mean).sum())
        self._penalties.extend(info["penalty"] for info in infos if "penalty" in info)
        whole = [info for info in infos if "surrogym_session_lost" not in info]
        self._seen = max([self._seen, *(info["episode"]["r"] for info in whole if "episode" in info)])
        self.lost += len(infos) - len(whole)
        return not self.given_up

    def _on_rollout_end(self) -> None:
        share = self._penalty / self._size if self._size else 0.0
        self._penalty = self._size = 0.0
        self._rollouts += 1
        self.logger.record("surrogym/penalty_share", share)
        if self.steps * CHECKS >= (self._checked + 1) * self._planned:
            self._check()
            self.given_up = self._hopeless()
        if self._progress is not None:
            steps = min(self.steps, self._total)
            self._progress(TrainProgress(steps, self._total, self._latest, share, self.episode_penalty))

    def _on_training_end(self) -> None:
        if self.given_up:
            self._spent, self.num_timesteps = self.steps, 0
        else:
            self._check()

    def _check(self) -> None:
        self._checked = int(self.steps * CHECKS / self._planned)
        self._latest = self._imagine(self.model)
        self.logger.record("surrogym/imagined_return", self._latest)
        if self.best is None or self._latest >= self.best:
            self._keep(self._latest, self.model)
        assert self.best is not None
        self._bests.append((self.steps, self.best))

    def _keep(self, earned: float, learner: BaseAlgorithm) -> None:
        self.best = earned
        self._kept = learner, {name: tensor.clone() for name, tensor in learner.policy.state_dict().items()}

    def _hopeless(self) -> bool:
        assert self.best is not None
        tried = self._rollouts >= PATIENT_ROLLOUTS and self.num_timesteps >= PATIENCE * self._planned
        bar = self._half_way if self.num_timesteps >= PROOF * self._planned else self._nothing
        return tried and self.best <= max(bar, self._nothing) and self._planned - self.steps >= PATIENCE * self._planned
