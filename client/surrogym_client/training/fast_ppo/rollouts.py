"""Rollouts of N lanes for T steps, with rewards scaled and advantages estimated."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.lanes import Lanes, LaneStep
from surrogym_client.training.fast_ppo.learner import Learner
from surrogym_client.training.fast_ppo.mlp import Array

LARGEST_REWARD = 10.0  # after scaling
LATEST_EPISODES = 100


@dataclass(frozen=True)
class Rollout:
    """What T steps of N lanes gave; rows are T N transitions, lane by lane within a step."""

    observations: Array  # (T N, D) standardised
    actions: Array  # (T N, F)
    log_probabilities: Array  # (T N,)
    advantages: Array  # (T N,)
    returns: Array  # (T N,) of the scaled rewards, what the critic learns
    earned: list[float]  # by the episodes that ended, not scaled
    penalty_share: float  # of the reward's size
    lost: int  # episodes cut because the server lost the session


class Collector:
    """The lanes between two rollouts: where they stand, and what their running episodes earned.

    Args:
        lanes: of an open session with autoreset in the same step.
        gamma: discount.
        gae_lambda: lambda of the generalised advantage estimate (Schulman et al. 2016).
        rng: of the actions' noise.
    """

    def __init__(self, lanes: Lanes, gamma: float, gae_lambda: float, rng: np.random.Generator) -> None:
        self._lanes, self._gamma, self._lambda, self._rng = lanes, gamma, gae_lambda, rng
        self._observation = lanes.reset().observation
        self._scale = RewardScale(lanes.num_envs, gamma)
        self._earned = np.zeros(lanes.num_envs)  # by the running episodes
        self._penalty = np.zeros(lanes.num_envs)  # taken off them
        self._penalties: deque[float] = deque(maxlen=LATEST_EPISODES)

    @property
    def episode_penalty(self) -> float | None:
        """What the penalty took off an episode's return, mean of the last ones; None in a session without."""
        return float(np.mean(self._penalties)) if self._penalties else None

    def collect(self, learner: Learner, steps: int) -> Rollout:
        """Take ``steps`` steps with every lane; the policy acts with its noise."""
        n = self._lanes.num_envs
        observations, actions, logs = [], [], []
        rewards, ended = np.empty((steps, n), dtype=np.float32), np.empty((steps, n), dtype=bool)
        cut: list[tuple[int, NDArray[Any], NDArray[Any]]] = []  # step, lanes, and what they saw last
        earned: list[float] = []
        size = taken = 0.0
        lost = 0
        for t in range(steps):
            x = learner.standardised(self._observation)
            action, log = learner.act(x, self._rng)
            observations.append(x)
            actions.append(action)
            logs.append(log)
            step = self._lanes.step(learner.distribution.sent(action))
            result = step.result
            ended[t] = result.terminated | result.truncated
            rewards[t] = self._scale(result.reward, ended[t])
            penalty = result.reward_mean - result.reward
            self._earned += result.reward
            self._penalty += penalty
            if ended[t].any():
                cut.append((t, *_truncated(step)))
                earned += self._end(ended[t], step.cut)
            size += float(np.abs(result.reward_mean).sum())
            taken += float(np.abs(penalty).sum())
            lost += int(step.cut.sum())
            self._observation = result.observation
        seen = np.concatenate(observations)
        values = learner.values(seen).reshape(steps, n)
        self._bootstrap(learner, rewards, cut)
        last = learner.values(learner.standardised(self._observation))
        advantages = self._advantages(rewards, ended, values, last)
        return Rollout(
            seen,
            np.concatenate(actions),
            np.concatenate(logs),
            advantages.ravel(),
            (advantages + values).ravel(),
            earned,
            taken / size if size else 0.0,
            lost,
        )

    def _end(self, ended: NDArray[np.bool_], lost: NDArray[np.bool_]) -> list[float]:
        """End the episodes of these lanes (N,); what they earned, but for those that were lost."""
        earned: list[float] = self._earned[ended & ~lost].tolist()
        if self._lanes.view.penalty > 0:
            self._penalties.extend(self._penalty[ended].tolist())
        self._earned[ended] = 0.0
        self._penalty[ended] = 0.0
        return earned

    def _bootstrap(self, learner: Learner, rewards: Array, cut: list[tuple[int, Any, Any]]) -> None:
        """Add to the last reward of a truncated episode what the critic expects beyond it."""
        counts = [len(lanes) for _, lanes, _ in cut]
        if not sum(counts):
            return
        beyond = learner.values(learner.standardised(np.concatenate([seen for _, _, seen in cut])))
        at = np.repeat([t for t, _, _ in cut], counts), np.concatenate([lanes for _, lanes, _ in cut])
        rewards[at] += np.float32(self._gamma) * beyond

    def _advantages(self, rewards: Array, ended: NDArray[np.bool_], values: Array, last: Array) -> Array:
        """Generalised advantage estimates (T, N)."""
        advantages, following, running = np.empty_like(rewards), last, np.zeros_like(last)
        gamma, decay = np.float32(self._gamma), np.float32(self._gamma * self._lambda)
        for t in reversed(range(len(rewards))):
            going = (~ended[t]).astype(np.float32)
            running = rewards[t] + gamma * following * going - values[t] + decay * going * running
            advantages[t], following = running, values[t]
        return advantages


class RewardScale:
    """Rewards over the running deviation of discounted returns, as Stable-Baselines3's ``VecNormalize`` has it."""

    def __init__(self, lanes: int, gamma: float) -> None:
        self._gamma = gamma
        self._returns = np.zeros(lanes)
        self._mean, self._variance, self._count = 0.0, 1.0, 1e-4

    def __call__(self, reward: NDArray[Any], ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Scaled rewards (N,); episodes that ``ended`` (N,) begin anew."""
        self._returns = self._returns * self._gamma + reward
        self._learn()
        scaled = np.clip(reward / np.sqrt(self._variance + 1e-8), -LARGEST_REWARD, LARGEST_REWARD)
        self._returns[ended] = 0.0
        return np.asarray(scaled, dtype=np.float64)

    def _learn(self) -> None:
        """Mean and variance of all returns so far and these (Chan et al. 1979)."""
        new, n = self._returns, len(self._returns)
        delta, count = float(new.mean()) - self._mean, self._count + n
        between = delta**2 * self._count * n / count
        self._variance = (self._variance * self._count + float(new.var()) * n + between) / count
        self._mean, self._count = self._mean + delta * n / count, count


def _truncated(step: LaneStep) -> tuple[NDArray[Any], NDArray[Any]]:
    """Lanes whose episode was cut short in this step, and what they saw last."""
    result = step.result
    short = (result.truncated & ~result.terminated)[result.final_lanes]
    return result.final_lanes[short], result.final_observation[short]
