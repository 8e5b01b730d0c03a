"""Run a policy in the lanes of a session: by one request for a whole rollout if the interface of the surrogate (port)
supports this, else step by step.

Shapes: N lanes, D observation entries, F action entries, T steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_client.environments.lanes import Lanes
from surrogym_shared.acting import Acted, ActingPolicy, Actor, NoiseKey
from surrogym_shared.network import bounds_of
from surrogym_shared.policy_sizes import MAX_ACTIVATIONS, MAX_LANE_STEPS
from surrogym_shared.port import Bools, Floats, PolicyRollout, StepResult


@dataclass(frozen=True)
class Taken:
    """Record of T steps of a policy, with the observations that it acted on."""

    rollout: PolicyRollout
    seen: Floats  # (T, N, D) observations of the N lanes before each of the T steps
    cut: Bools  # (T, N) whether a step ends the episode of a lane, because the server lost the session


class ActingLanes:
    """Lanes in which a policy acts in rollouts. Each rollout continues from the last observations of the one before.

    Args:
        lanes: lanes of a session with autoreset in the same step.
    """

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self._observation: Floats = np.zeros(0)

    def reset(self, seed: int | Sequence[int] | None = None) -> None:
        """Start new episodes in all lanes."""
        self._observation = self.lanes.reset(seed).observation

    def take(
        self, policy: ActingPolicy, steps: int, noise: NoiseKey | None = None, until: Bools | None = None
    ) -> Taken:
        """Step all lanes at most ``steps`` times with a policy, and return the record of the steps.

        Args:
            policy: the policy.
            steps: largest number of steps.
            noise: key of the actions' random noise; None takes the most probable actions.
            until: mask (N,) of lanes; stepping stops once an episode has ended in each of them.
        """
        first, done = self._observation, _Done([], [], [], [])
        waiting = np.ones(self.lanes.num_envs, dtype=bool) if until is None else until
        while len(done.results) < steps and waiting.any():
            at = len(done.results)
            key = None if noise is None else noise.later(at)
            rolled = self._rolled(policy, steps - at, key, None if until is None else waiting)
            if rolled is not None and at == 0 and len(rolled) == steps:
                return self._taken(rolled, first, np.zeros(rolled.reward.shape, dtype=bool))
            if rolled is None:
                self._step(policy, key, done)
            else:
                done.add(rolled)
            if until is not None:
                ended = [one.terminated | one.truncated for one in done.results[at:]]
                waiting = waiting & ~np.any(ended, axis=0)
        log = None if noise is None else np.stack(done.logs).astype(np.float64)
        rollout = PolicyRollout.of(done.results, np.stack(done.actions).astype(np.float64), log)
        return self._taken(rollout, first, np.stack(done.cut))

    def _taken(self, rollout: PolicyRollout, first: Floats, cut: Bools) -> Taken:
        self._observation = rollout.observation[-1]
        return Taken(rollout, np.concatenate([first[None], rollout.observation[:-1]]), cut)

    def _rolled(
        self, policy: ActingPolicy, steps: int, noise: NoiseKey | None, until: Bools | None
    ) -> PolicyRollout | None:
        lanes = self.lanes.num_envs
        if not self.lanes.rolls_policies or lanes * max(policy.units) > MAX_ACTIVATIONS:
            return None
        rolled = self.lanes.rollout(policy, min(steps, MAX_LANE_STEPS // lanes), noise, until)
        if rolled is not None:
            self._observation = rolled.observation[-1]
        return rolled

    def _step(self, policy: ActingPolicy, noise: NoiseKey | None, done: _Done) -> None:
        acted = self._actor(policy, noise).act(self._observation, noise)
        step = self.lanes.step(acted.sent)
        self._observation = step.result.observation
        done.step(step.result, acted, step.cut)

    def _actor(self, policy: ActingPolicy, noise: NoiseKey | None) -> Actor:
        spec = self.lanes.port.spec()
        size = len(spec.observation)
        return Actor(policy, size, *bounds_of(spec), spec.action.policy_counts, noisy=noise is not None)


@dataclass(frozen=True)
class _Done:
    """Record of the steps that a rollout has taken so far, with an entry of each list for each step."""

    results: list[StepResult]
    actions: list[Floats]  # (N, F) actions of the N lanes in each step
    logs: list[Floats]  # (N,) log probabilities of each step's actions; empty without noise
    cut: list[Bools]  # (N,) lanes whose episode each step ends because the server lost the session

    def step(self, result: StepResult, acted: Acted, cut: Bools) -> None:
        self.results.append(result)
        self.actions.append(acted.action)
        self.cut.append(cut)
        if acted.log_probability is not None:
            self.logs.append(acted.log_probability)

    def add(self, rolled: PolicyRollout) -> None:
        self.results.extend(rolled.steps())
        self.actions.extend(rolled.action)
        self.cut.extend(np.zeros(rolled.reward.shape, dtype=bool))
        if rolled.log_probability is not None:
            self.logs.extend(rolled.log_probability)
