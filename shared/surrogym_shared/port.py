"""SurrogatePort: what a trainer needs of a surrogate, however it is reached.

It is implemented by JSON and frames over HTTP, by the stream of frames, and by the surrogate in this process; one suite
tests them all. Arrays are numpy: observation (N, D) float32, action (N, F) or (N,), reward (N,) float64, flags (N,)
bool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.acting import ActingPolicy, NoiseKey
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]
Ints = NDArray[np.integer[Any]]
T = TypeVar("T")


@dataclass(frozen=True)
class ResetResult:
    """Result of a reset of N lanes."""

    observation: Floats  # (N, D) first observations of the episodes
    model_version: Ints  # (N,) version of the model in each lane


@dataclass(frozen=True)
class StepResult:
    """Result of one step of N lanes."""

    observation: Floats  # (N, D) observations after the step
    reward: Floats  # (N,) rewards, less the penalty for uncertainty
    terminated: Bools  # (N,) whether the episode ended in a terminal state
    truncated: Bools  # (N,) whether the episode ended for another reason
    final_lanes: Ints  # (K,) lanes whose episode ended and that were reset within this step
    final_observation: Floats  # (K, D) last observations of the ended episodes
    model_version: Ints  # (N,) version of the model in each lane
    reward_mean: Floats  # (N,) rewards without the penalty for uncertainty
    deviation: Floats | None  # (N, O) predicted standard deviation of each output; None if it was not requested
    untrusted: Bools | None = (
        None  # (N,) lanes truncated because they left the trusted range; None in a session without one
    )


@dataclass(frozen=True)
class PolicyRollout:
    """Result of T steps of N lanes under a policy, with the policy's actions."""

    action: Floats  # (T, N, F) float64 actions before they are clipped to their bounds
    log_probability: Floats | None  # (T, N) float64 log probability of each action; None without noise
    observation: Floats  # (T, N, D) observations after each step; action t was chosen at observation t - 1
    reward: Floats  # (T, N) rewards, less the penalty for uncertainty
    terminated: Bools  # (T, N) whether the episode ended in a terminal state
    truncated: Bools  # (T, N) whether the episode ended for another reason
    final_steps: Ints  # (K,) steps in which a lane's episode ended and the lane was reset, in order
    final_lanes: Ints  # (K,) lane of each episode in ``final_steps``
    final_observation: Floats  # (K, D) last observation of each episode in ``final_steps``
    model_version: Ints  # (T, N) version of the model in each step
    reward_mean: Floats  # (T, N) rewards without the penalty for uncertainty
    untrusted: Bools | None = None  # (T, N) whether a lane left the trusted range; None without such a range

    def __len__(self) -> int:
        return len(self.reward)

    @classmethod
    def of(cls, steps: Sequence[StepResult], action: Floats, log_probability: Floats | None) -> Self:
        """Combine the results of at least one step, and the policy's actions in them."""
        untrusted = [step.untrusted for step in steps if step.untrusted is not None]
        return cls(
            action=action,
            log_probability=log_probability,
            observation=np.stack([step.observation for step in steps]),
            reward=np.stack([step.reward for step in steps]),
            terminated=np.stack([step.terminated for step in steps]),
            truncated=np.stack([step.truncated for step in steps]),
            final_steps=np.repeat(np.arange(len(steps)), [len(step.final_lanes) for step in steps]),
            final_lanes=np.concatenate([step.final_lanes for step in steps]),
            final_observation=np.concatenate([step.final_observation for step in steps]),
            model_version=np.stack([step.model_version for step in steps]),
            reward_mean=np.stack([step.reward_mean for step in steps]),
            untrusted=np.stack(untrusted) if len(untrusted) == len(steps) else None,
        )

    def steps(self) -> list[StepResult]:
        """Return the result of each step, as ``SurrogatePort.step`` would, as views of the rollout's arrays."""
        ends = np.searchsorted(self.final_steps, np.arange(len(self) + 1))
        return [
            StepResult(
                observation=self.observation[t],
                reward=self.reward[t],
                terminated=self.terminated[t],
                truncated=self.truncated[t],
                final_lanes=self.final_lanes[ends[t] : ends[t + 1]],
                final_observation=self.final_observation[ends[t] : ends[t + 1]],
                model_version=self.model_version[t],
                reward_mean=self.reward_mean[t],
                deviation=None,
                untrusted=None if self.untrusted is None else self.untrusted[t],
            )
            for t in range(len(self))
        ]


def quick(kind: type[T], **fields: Any) -> T:
    """Make an instance of a frozen dataclass from all its fields, in half the time of its constructor: every virtual
    step makes two instances."""
    instance = object.__new__(kind)
    instance.__dict__.update(fields)
    return instance


@runtime_checkable
class SurrogatePort(Protocol):
    """One surrogate, as a trainer uses it.

    Laws: a step happens once, however often the transport repeats it. A repeat gives the same reply, bit for bit.
    Results of a session depend only on its seed and its requests. An error has the same class name in the error tree of
    every implementation (``surrogym_client.errors``, ``surrogym_server.errors``).
    """

    def spec(self) -> EnvironmentSpec:
        """Return the specification of the original environment."""
        ...

    def open(self, request: OpenSession) -> SessionView:
        """Open a session of N lanes."""
        ...

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        """Start new episodes in all lanes, or only in those of the mask (N,)."""
        ...

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        """Step all lanes, or only those of the mask (N,), with an action (N, F)."""
        ...

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        """Step all lanes T times with actions (T, N, F), in one request."""
        ...

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """Submit the states that a session visited as those of a policy's checkpoint, so that queries are chosen there.

        Returns how certain the model is at these states.
        """
        ...

    def close(self, session: str) -> None:
        """Close the session. Closing it twice is harmless."""
        ...


@runtime_checkable
class PolicyPort(SurrogatePort, Protocol):
    """A surrogate that can also run a policy itself, so that a rollout of many steps is one request.

    Law: the result equals stepping all lanes one by one with the actions of ``surrogym_shared.acting.Actor``, bit for
    bit if both run the same NumPy on the same kind of processor.
    """

    def rollout_policy(
        self,
        session: str,
        policy: ActingPolicy,
        steps: int,
        *,
        noise: NoiseKey | None = None,
        until: Bools | None = None,
    ) -> PolicyRollout:
        """Step all lanes with a policy, in one request. Either all steps are taken or none.

        Args:
            session: id of a session whose lanes have been reset.
            policy: the policy.
            steps: largest number of steps, T.
            noise: key of the actions' noise; None takes the most probable actions.
            until: mask (N,) of lanes; the rollout stops after the step by which an episode has ended in each of them.
        """
        ...
