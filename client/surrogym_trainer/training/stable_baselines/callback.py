"""A callback of Stable-Baselines3 that checks a training by the policy's imagined return."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from surrogym_trainer.training.checks import Checks, Returns
from surrogym_trainer.training.settings import CHECKS, TrainProgress


class Checking(BaseCallback):
    """Callback that measures the imagined return, keeps the best policy, and reports progress and the penalty's size.

    Args:
        total: virtual steps of the training.
        progress: called after every rollout.
        imagine: measures a learner's returns in virtual episodes.
        untrained: a learner with an untrained network.
    """

    def __init__(
        self,
        total: int,
        progress: Callable[[TrainProgress], None],
        imagine: Callable[[BaseAlgorithm], Returns],
        untrained: BaseAlgorithm,
    ) -> None:
        super().__init__()
        self._total, self._progress, self._imagine = total, progress, imagine
        self.checks = Checks(imagine(untrained))
        # the best learner, and its parameters at the check
        self._kept: tuple[BaseAlgorithm, dict[str, Any]] | None = None
        self._penalty = self._size = 0.0
        self._penalties: deque[float] = deque(maxlen=100)  # penalties for uncertainty of the last episodes
        self._checked = 0  # number of checks that were due so far
        self.steps = self.lost = 0

    @property
    def episode_penalty(self) -> float | None:
        return float(np.mean(self._penalties)) if self._penalties else None

    def check(self, learner: BaseAlgorithm) -> None:
        """Measure a policy, and keep it if it is the best so far."""
        if self.checks.add(self._imagine(learner)):
            self._kept = learner, {name: tensor.clone() for name, tensor in learner.policy.state_dict().items()}

    def best_of(self, last: BaseAlgorithm) -> BaseAlgorithm:
        """Return the learner with the best imagined return of all checks, with its parameters of that check.

        If there was no check, the last learner is returned.
        """
        if self._kept is None:
            return last
        learner, parameters = self._kept
        learner.policy.load_state_dict(parameters)
        return learner

    def _on_step(self) -> bool:
        infos, env = self.locals["infos"], self.training_env
        assert isinstance(env, VecNormalize)
        reward = env.get_original_reward()
        mean = np.array([info["reward_mean"] for info in infos])
        self._penalty += float(np.abs(mean - reward).sum())
        self._size += float(np.abs(mean).sum())
        self._penalties.extend(info["penalty"] for info in infos if "penalty" in info)
        self.steps = self.num_timesteps
        self.lost += sum("surrogym_session_lost" in info for info in infos)
        return True

    def _on_rollout_end(self) -> None:
        share = self._penalty / self._size if self._size else 0.0
        self._penalty = self._size = 0.0
        self.logger.record("surrogym/penalty_share", share)
        due = self.steps * CHECKS // self._total
        if due > self._checked:
            self._checked = due
            self._check_now()
        steps = min(self.steps, self._total)
        self._progress(TrainProgress(steps, self._total, self.checks.latest, share, self.episode_penalty))

    def _on_training_end(self) -> None:
        self._check_now()

    def _check_now(self) -> None:
        self.check(self.model)
        self.logger.record("surrogym/imagined_return", self.checks.latest)
