"""Comparison of a deployed controller with the policy that it was made from, by their actions and returns.

Shapes: R measurements, F action entries.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.rates import within_rates
from surrogym_trainer.deployment.controller import LIMITED, Array, Controller
from surrogym_trainer.policies.predict import Acting, PerEpisode

# if a controller computes in double, and in float: largest negligible difference of an action, as a share of its range
NEGLIGIBLE = 1e-6, 1e-4


class Running(ABC):
    """A running controller of some target.

    Attributes:
        microseconds: duration of one decision; None if it was not measured.
        single: whether it computes in float instead of double.
    """

    microseconds: float | None = None
    single = False

    @abstractmethod
    def reset(self) -> None:
        """Forget earlier steps, and begin an episode."""

    @abstractmethod
    def step(self, measurement: Array, age: float = 0.0) -> tuple[int, Array]:
        """Return the status and the action (F,) for measurements (R,) of an age in seconds. Each kind of fault, and a
        limit that would be left soon, has a bit of the status, which is 0 without these."""


@dataclass(frozen=True, eq=False)
class Checked:
    """The results of a controller and of its policy, from the same N starts."""

    returns: Array  # (N,) sum of rewards of the controller in each of N episodes
    policy_returns: Array  # (N,) sum of rewards of the policy in each of N episodes
    steps: int  # number of steps of the controller
    # largest difference between an action of the controller and the policy's in the same state, as a share of the
    # action's range
    largest: float
    # number of steps in which the controller made another discrete choice than the policy, or in which the actions
    # differ by more than 1e-6 of the range (1e-4 if the controller computes in float)
    different: int
    faults: int  # number of steps in which the controller took its fallback action because of a fault
    microseconds: float | None


class Comparison:
    """Runs episodes of a deployed controller and of its policy from the same starts, and compares their actions.

    Args:
        controller: the controller that was deployed.
        running: the deployed controller, running.
        policy: the original policy.
        episode: an instance of the environment.
    """

    def __init__(self, controller: Controller, running: Running, policy: Acting, episode: Episode) -> None:
        self.begun = 0  # number of steps of the environment that have begun, of controller and policy together
        self.ended = 0  # number of episodes that have ended, of controller and policy together
        self._running, self._policy, self._episode = running, policy, episode
        self._places = [m.place for m in controller.measurements]
        self._width, self._rates = controller.high - controller.low, controller.rates
        self._differences: list[float] = []
        self._faults = 0

    def over(self, seeds: range, progress: Callable[[float], None]) -> Checked:
        """Run an episode of the controller and one of the policy for every reset seed.

        ``progress`` is called with the share of episodes that are done.
        """
        returns: list[tuple[float, float]] = []
        for seed in seeds:
            returns.append((self._run(seed, deployed=False), self._run(seed, deployed=True)))
            progress(len(returns) / len(seeds))
        differences = np.array(self._differences)
        return Checked(
            returns=np.array([deployed for _, deployed in returns]),
            policy_returns=np.array([original for original, _ in returns]),
            steps=len(differences),
            largest=float(differences.max()),
            different=int((differences > NEGLIGIBLE[self._running.single]).sum()),
            faults=self._faults,
            microseconds=self._running.microseconds,
        )

    def _run(self, seed: int, *, deployed: bool) -> float:
        """Run one episode, of the deployed controller or of the policy, and return the sum of its rewards."""
        moment, total = self._episode.reset(seed), 0.0
        self._running.reset()
        for _ in range(self._episode.spec.time_limit or LONGEST_EPISODE):
            action = decode_actions(self._episode.spec, self._acting(moment.observation[None].astype(np.float32)), 1)[0]
            if deployed:
                action = self._decided(moment, within_rates(self._rates, moment.coordinates, action))
            self.begun += 1
            moment = self._episode.step(action)
            total += moment.reward
            if moment.terminated or moment.truncated:
                break
        self.ended += 1
        return total

    def _acting(self, observation: NDArray[np.float32]) -> NDArray[Any]:
        """Return the policy's action (1, F) for an observation (1, D) of the present episode."""
        if isinstance(self._policy, PerEpisode):
            return self._policy.actions([self.ended], observation)
        return self._policy(observation)

    def _decided(self, moment: Moment, expected: Array) -> Array:
        """Return the deployed controller's action (F,) for the coordinates of this moment, and record its difference
        from the policy's action, ``expected`` (F,)."""
        status, action = self._running.step(moment.coordinates[self._places])
        self._faults += status not in (0, LIMITED)
        self._differences.append(float((np.abs(action - expected) / self._width).max()) if status == 0 else 0.0)
        return action
