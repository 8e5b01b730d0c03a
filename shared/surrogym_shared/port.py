"""SurrogatePort: what a trainer needs of a surrogate, whatever carries it.

JSON and frames over HTTP, the stream of frames and the in-process surrogate implement it; one suite tests them all.
Arrays are numpy: observation (N, D) float32, action (N, F) or (N,), reward (N,) float64, flags (N,) bool.
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
    observation: Floats  # (N, D)
    model_version: Ints  # (N,)


@dataclass(frozen=True)
class StepResult:
    observation: Floats  # (N, D)
    reward: Floats  # (N,), penalised
    terminated: Bools  # (N,)
    truncated: Bools  # (N,)
    final_lanes: Ints  # (K,) lanes that ended and were reset within this step
    final_observation: Floats  # (K, D)
    model_version: Ints  # (N,)
    reward_mean: Floats  # (N,), before the penalty
    deviation: Floats | None  # (N, O) when asked for
    untrusted: Bools | None = None  # (N,) lanes truncated for leaving the trusted range; None in a session without one


@dataclass(frozen=True)
class PolicyRollout:
    """T steps of N lanes under a policy: what it did in each, and what came of that."""

    action: Floats  # (T, N, F) float64, before it is clipped to its bounds
    log_probability: Floats | None  # (T, N) float64 of it; None without noise
    observation: Floats  # (T, N, D) after the step; the first action is for what the lanes showed before
    reward: Floats  # (T, N), penalised
    terminated: Bools  # (T, N)
    truncated: Bools  # (T, N)
    final_steps: Ints  # (K,) steps in which a lane ended and was reset, in order
    final_lanes: Ints  # (K,) that lane
    final_observation: Floats  # (K, D)
    model_version: Ints  # (T, N)
    reward_mean: Floats  # (T, N), before the penalty
    untrusted: Bools | None = None  # (T, N); None in a session without a trusted range

    def __len__(self) -> int:
        return len(self.reward)

    @classmethod
    def of(cls, steps: Sequence[StepResult], action: Floats, log_probability: Floats | None) -> Self:
        """One from its steps, at least one, and what the policy did in them."""
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
        """Each step as ``SurrogatePort.step`` gives it; views of these arrays."""
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
    """A frozen dataclass of all its fields, at half the cost of its constructor, which every step pays twice."""
    made = object.__new__(kind)
    made.__dict__.update(fields)
    return made


@runtime_checkable
class SurrogatePort(Protocol):
    """One surrogate, seen by a trainer.

    Laws: a step happens once, however often the transport repeats it; a repeat gives the same reply, bit for bit;
    results of one session depend on its seed and its requests alone; an error has the same class name in every
    implementation's tree (``surrogym_client.errors``, ``surrogym_server.errors``).
    """

    def spec(self) -> EnvironmentSpec:
        """The specification of the original environment."""
        ...

    def open(self, request: OpenSession) -> SessionView:
        """Open a session of N lanes."""
        ...

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        """Start new episodes in all lanes, or those of the mask."""
        ...

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        """Step all lanes, or those of the mask."""
        ...

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        """Step T times with actions (T, N, F), in one request."""
        ...

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """Store the states this session visited under a name, for the design to weigh its queries by, and say how well
        the model is known there."""
        ...

    def close(self, session: str) -> None:
        """End the session; closing twice is harmless."""
        ...


@runtime_checkable
class PolicyPort(SurrogatePort, Protocol):
    """A surrogate that lets a policy act where the lanes are stepped.

    Law: the same as stepping all lanes one by one with the actions of ``surrogym_shared.acting.Actor``, bit for bit
    where both run the same NumPy on the same kind of processor.
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
        """Let a policy act in all lanes, in one request; all steps or none.

        Args:
            session: its lanes have been reset.
            policy: what acts.
            steps: how many at most, T.
            noise: of its actions; the most probable ones without.
            until: (N,) lanes; the rollout stops after the step by which an episode has ended in each of them.
        """
        ...
