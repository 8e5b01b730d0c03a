"""Rollouts of N lanes (environments that step together) for T steps, with scaled rewards and estimated advantages."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.acting import ActingLanes
from surrogym_client.environments.lanes import Lanes
from surrogym_shared.acting import NoiseKey
from surrogym_shared.port import PolicyRollout
from surrogym_trainer.training.fast_ppo.learner import Array, Batch, Learner

LARGEST_REWARD = 10.0  # largest absolute reward after scaling
LATEST_EPISODES = 100


@dataclass(frozen=True)
class Rollout:
    """The result of T steps of N lanes. Its T N rows are transitions, ordered by step and then by lane."""

    rows: Batch
    earned: list[float]  # unscaled returns of the episodes that ended
    penalty_share: float  # sum of the penalties for uncertainty, as a share of the sum of absolute rewards
    lost: int  # number of episodes that were cut because the server lost the session


class Collector:
    """Collects rollouts from lanes, and keeps their observations and running returns between two rollouts.

    Args:
        lanes: lanes of an open session with autoreset in the same step.
        gamma: discount factor.
        gae_lambda: lambda of the generalised advantage estimate (Schulman et al. 2016).
        seed: seed of the actions' noise.
    """

    def __init__(self, lanes: Lanes, gamma: float, gae_lambda: float, seed: int) -> None:
        self._gamma, self._lambda, self._noise = gamma, gae_lambda, NoiseKey(seed)
        self._lanes, self._penalised = ActingLanes(lanes), lanes.penalised
        self._lanes.reset()
        self._scale = RewardScale(lanes.num_envs, gamma)
        self._earned = np.zeros(lanes.num_envs)  # (N,) returns of the running episodes
        # (N,) penalties for uncertainty that were subtracted from the returns of the running episodes
        self._penalty = np.zeros(lanes.num_envs)
        self._penalties: deque[float] = deque(maxlen=LATEST_EPISODES)

    @property
    def episode_penalty(self) -> float | None:
        """The mean penalty of an episode, over the last episodes; None if the session has no penalty."""
        return float(np.mean(self._penalties)) if self._penalties else None

    def collect(self, learner: Learner, steps: int, hold: int = 1) -> Rollout:
        """Take ``steps`` steps in every lane. The policy acts with noise that stays the same for ``hold`` steps."""
        taken = self._lanes.take(learner.acting(), steps, self._noise._replace(hold=hold))
        self._noise = self._noise.later(steps)
        rollout = taken.rollout
        assert rollout.log_probability is not None
        ended = rollout.terminated | rollout.truncated
        penalty = rollout.reward_mean - rollout.reward
        rewards, earned = np.empty(ended.shape, dtype=np.float32), []
        for t in range(steps):
            rewards[t] = self._scale(rollout.reward[t], ended[t])
            self._earned += rollout.reward[t]
            self._penalty += penalty[t]
            if ended[t].any():
                earned += self._end(ended[t], taken.cut[t])
        seen = learner.standardised(taken.seen.reshape(rewards.size, -1))
        values = learner.values(seen).reshape(rewards.shape)
        self._bootstrap(learner, rewards, rollout)
        last = learner.values(learner.standardised(rollout.observation[-1]))
        advantages = self._advantages(rewards, ended, values, last)
        size = float(np.abs(rollout.reward_mean).sum())
        rows = Batch(
            seen,
            rollout.action.reshape(rewards.size, -1).astype(np.float32),
            rollout.log_probability.ravel().astype(np.float32),
            advantages.ravel(),
            (advantages + values).ravel(),
        )
        return Rollout(
            rows,
            earned,
            float(np.abs(penalty).sum()) / size if size else 0.0,
            int(taken.cut.sum()),
        )

    def _end(self, ended: NDArray[np.bool_], lost: NDArray[np.bool_]) -> list[float]:
        """Begin the sums of returns anew in the lanes that ``ended`` (N,) marks. Returns the returns of the ended
        episodes, except in the lanes ``lost`` (N,), whose session the server lost."""
        earned: list[float] = self._earned[ended & ~lost].tolist()
        if self._penalised:
            self._penalties.extend(self._penalty[ended].tolist())
        self._earned[ended] = 0.0
        self._penalty[ended] = 0.0
        return earned

    def _bootstrap(self, learner: Learner, rewards: Array, rollout: PolicyRollout) -> None:
        """Add the critic's value of the last observation to the last reward of each truncated episode."""
        at = rollout.final_steps, rollout.final_lanes
        short = (rollout.truncated & ~rollout.terminated)[at]
        if not short.any():
            return
        beyond = learner.values(learner.standardised(rollout.final_observation[short]))
        rewards[at[0][short], at[1][short]] += np.float32(self._gamma) * beyond

    def _advantages(self, rewards: Array, ended: NDArray[np.bool_], values: Array, last: Array) -> Array:
        """Return generalised advantage estimates (T, N).

        Args:
            rewards: scaled rewards (T, N).
            ended: whether each step ended its episode (T, N).
            values: the critic's values before each step (T, N).
            last: the critic's values after the last step (N,).
        """
        advantages, following, running = np.empty_like(rewards), last, np.zeros_like(last)
        gamma, decay = np.float32(self._gamma), np.float32(self._gamma * self._lambda)
        for t in reversed(range(len(rewards))):
            going = (~ended[t]).astype(np.float32)
            running = rewards[t] + gamma * following * going - values[t] + decay * going * running
            advantages[t], following = running, values[t]
        return advantages


class RewardScale:
    """Scaling of rewards by the running standard deviation of discounted returns, as in Stable-Baselines3's
    ``VecNormalize``."""

    def __init__(self, lanes: int, gamma: float) -> None:
        self._gamma = gamma
        self._returns = np.zeros(lanes)
        self._mean, self._variance, self._count = 0.0, 1.0, 1e-4

    def __call__(self, reward: NDArray[Any], ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Scale the rewards (N,) of a step. In lanes that ``ended`` (N,) marks, the discounted return restarts at 0."""
        self._returns = self._returns * self._gamma + reward
        self._learn()
        scaled = np.clip(reward / np.sqrt(self._variance + 1e-8), -LARGEST_REWARD, LARGEST_REWARD)
        self._returns[ended] = 0.0
        return np.asarray(scaled, dtype=np.float64)

    def _learn(self) -> None:
        """Update mean and variance by the current returns (Chan et al. 1979)."""
        new, n = self._returns, len(self._returns)
        delta, count = float(new.mean()) - self._mean, self._count + n
        between = delta**2 * self._count * n / count
        self._variance = (self._variance * self._count + float(new.var()) * n + between) / count
        self._mean, self._count = self._mean + delta * n / count, count
