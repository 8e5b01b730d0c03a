"""PPO and SAC of Stable-Baselines3 in the original environment, with that library's default settings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.port import BudgetSpent, Real
from surrogym_shared.spec import BoxAction, DiscreteAction
from surrogym_trainer.policies.predict import Acting


class RealEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """The counted environment for Stable-Baselines3.

    Args:
        real: counts the steps.
        boxed: offer a discrete action as a number in [-1, 1], which is rounded.
    """

    def __init__(self, real: Real, *, boxed: bool) -> None:
        self._real = real
        self._states = States(real.spec)
        width, action = len(real.spec.observation), real.spec.action
        self.observation_space = spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self._discrete = isinstance(action, DiscreteAction) and not boxed
        if isinstance(action, DiscreteAction) and self._discrete:
            self.action_space = spaces.Discrete(action.n)
        elif isinstance(action, BoxAction):
            self.action_space = spaces.Box(np.array(action.low, np.float32), np.array(action.high, np.float32))
        else:
            self.action_space = spaces.Box(-1, 1, (action.size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed, options=options)
        return self._real.reset().observation.astype(np.float32), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        moment = self._real.step(self.native(np.asarray(action)[None])[0])
        return moment.observation.astype(np.float32), moment.reward, moment.terminated, moment.truncated, {}

    def native(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Actions (N, F) of the environment for actions (N, ...) of the policy."""
        rows = actions.reshape(len(actions), -1).astype(np.float64)
        return rows if self._discrete or isinstance(self._real.spec.action, BoxAction) else self._states.native(rows)


class ModelFree:
    """An algorithm of Stable-Baselines3, by name."""

    def __init__(self, algorithm: str, *, boxed: bool) -> None:
        self._algorithm = algorithm
        self._boxed = boxed

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Learn, and yield the policy at 1, 2 and 5 times each power of ten, from 1,000 real steps on."""
        import stable_baselines3

        env = RealEnv(real, boxed=self._boxed)
        learner = getattr(stable_baselines3, self._algorithm)("MlpPolicy", env, seed=seed, device="cpu")

        def act(observations: NDArray[np.float32]) -> NDArray[Any]:
            return env.native(np.asarray(learner.predict(observations, deterministic=True)[0]))

        for goal in goals(real.budget):
            if goal > real.steps:
                try:
                    learner.learn(goal - real.steps, reset_num_timesteps=False)
                except BudgetSpent:  # within a rollout of PPO; the policy has learned from all before it
                    yield act
                    raise
                yield act


def goals(budget: int) -> list[int]:
    """Real steps at which a round ends, up to the budget, which is one of them."""
    found = [factor * 10**power for power in range(3, 8) for factor in (1, 2, 5)]
    return [*(goal for goal in found if goal < budget), budget]
