"""Checks of a training by imagined return, as a callback of Stable-Baselines3."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from surrogym_trainer.training.settings import TrainProgress
from surrogym_trainer.training.verdicts import Imagined, Verdicts


class Checks(BaseCallback):
    """Callback that measures the imagined return, keeps the best policy, and reports progress and the penalty's size.

    ``verdicts`` decides what follows from a check.

    Args:
        total: virtual steps of the training.
        progress: called after every rollout.
        imagine: measures a learner's returns in virtual episodes.
        untrained: a learner that has learned nothing yet.
        saved: policy of an earlier training; a network that does not come near it is abandoned.
    """

    def __init__(
        self,
        total: int,
        progress: Callable[[TrainProgress], None] | None,
        imagine: Callable[[BaseAlgorithm], Imagined],
        untrained: BaseAlgorithm,
        saved: BaseAlgorithm | None = None,
    ) -> None:
        super().__init__()
        self._progress = progress
        self._imagine = imagine
        self.verdicts = Verdicts(total, imagine(untrained), None if saved is None else imagine(saved))
        self._kept: tuple[BaseAlgorithm, dict[str, Any]] | None = (
            None  # the best learner, and its parameters at that check
        )
        self._penalty = self._size = 0.0
        self._penalties: deque[float] = deque(maxlen=100)  # of the last episodes
        self.lost = 0

    @property
    def episode_penalty(self) -> float | None:
        return float(np.mean(self._penalties)) if self._penalties else None

    def worth_keeping(self, known: BaseAlgorithm) -> bool:
        """Check a policy of an earlier training. If it had learned anything, it is kept as the best so far. Returns
        whether it is."""
        best, learned = self.verdicts.knows(self._imagine(known))
        if best:
            self._keep(known)
        return learned

    def best_of(self, last: BaseAlgorithm) -> BaseAlgorithm:
        """Return the learner with the best imagined return of all checks, with its parameters of that check.

        Without any check, the last learner is returned.
        """
        if self._kept is None:
            return last
        learner, parameters = self._kept
        learner.policy.load_state_dict(parameters)
        return learner

    def _on_training_start(self) -> None:
        self.verdicts.begin()

    def _on_step(self) -> bool:
        infos, env, verdicts = self.locals["infos"], self.training_env, self.verdicts
        assert isinstance(env, VecNormalize)
        reward = env.get_original_reward()
        mean = np.array([info["reward_mean"] for info in infos])
        self._penalty += float(np.abs(mean - reward).sum())
        self._size += float(np.abs(mean).sum())
        self._penalties.extend(info["penalty"] for info in infos if "penalty" in info)
        whole = [info for info in infos if "surrogym_session_lost" not in info]
        verdicts.saw(info["episode"]["r"] for info in whole if "episode" in info)
        verdicts.at(self.num_timesteps)
        self.lost += len(infos) - len(whole)
        return not verdicts.given_up

    def _on_rollout_end(self) -> None:
        verdicts = self.verdicts
        share = self._penalty / self._size if self._size else 0.0
        self._penalty = self._size = 0.0
        self.logger.record("surrogym/penalty_share", share)
        if verdicts.after_rollout():
            self._check()
            verdicts.judge()
        if self._progress is not None:
            steps = min(verdicts.steps, verdicts.total)
            self._progress(TrainProgress(steps, verdicts.total, verdicts.latest, share, self.episode_penalty))

    def _on_training_end(self) -> None:
        if not self.verdicts.given_up:
            self._check()

    def _check(self) -> None:
        imagined = self._imagine(self.model)
        self.logger.record("surrogym/imagined_return", imagined.mean)
        if self.verdicts.check(imagined):
            self._keep(self.model)

    def _keep(self, learner: BaseAlgorithm) -> None:
        self._kept = learner, {name: tensor.clone() for name, tensor in learner.policy.state_dict().items()}
