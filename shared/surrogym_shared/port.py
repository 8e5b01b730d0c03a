"""``SurrogatePort``: the interface of a surrogate for trainers, which is the same over HTTP and in process.

There are implementations by JSON and binary frames over HTTP, by a WebSocket with frames, and in this process; one
suite tests them all. N lanes step together. Arrays are of NumPy: observation (N, D) float32 with D entries, action (N,
F) with F entries or (N,), reward (N,) float64, and bool (N,) such as terminated. K is a number of ended episodes, T of
steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy

if TYPE_CHECKING:
    from surrogym_shared.acting import ActingPolicy, NoiseKey

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]
Ints = NDArray[np.integer[Any]]
T = TypeVar("T")


@dataclass(frozen=True)
class ResetResult:
    """Result of a reset of N lanes."""

    observation: Floats  # (N, D) first observation of the episode in each of N lanes, with D entries
    model_version: Ints  # (N,) version of the model that each lane's episode runs under


@dataclass(frozen=True)
class StepResult:
    """Result of one step of N lanes."""

    observation: Floats  # (N, D) observation of each of N lanes after the step, with D entries
    reward: Floats  # (N,) reward in each of N lanes, less the penalty for uncertainty
    terminated: Bools  # (N,) whether the episode in each of N lanes ended in a terminal state
    truncated: Bools  # (N,) whether the episode in each of N lanes ended for another reason than a terminal state
    final_lanes: Ints  # (K,) numbers of the K lanes whose episode ended and that were reset within this step
    # (K, D) last observation, of D entries, of the ended episode in each lane of ``final_lanes``.
    final_observation: Floats
    model_version: Ints  # (N,) version of the model that each lane's episode runs under
    reward_mean: Floats  # (N,) reward in each of N lanes without the penalty for uncertainty
    deviation: Floats | None  # (N, O) predicted standard deviation of O outputs in N lanes; None if not requested
    # (N,) whether each lane was truncated because the model is too uncertain there; None in a session without
    # ``trust``.
    untrusted: Bools | None = None
    # (N,) whether the lane's episode ended early: outside the sampling range, or where the model is too uncertain, if a
    # reward outside is declared; or where the fallback of declared limits acts. None if neither that reward nor limits
    # are declared.
    left: Bools | None = None


@dataclass(frozen=True)
class PolicyRollout:
    """Result of T steps of N lanes under a policy, with the policy's actions."""

    action: Floats  # (T, N, F) float64 actions of F entries in T steps of N lanes, not clipped to their bounds
    # (T, N) float64 log probability of each action, in T steps of N lanes; None without noise.
    log_probability: Floats | None
    observation: Floats  # (T, N, D) observation of D entries after each of T steps, in N lanes
    reward: Floats  # (T, N) reward in T steps of N lanes, less the penalty for uncertainty
    terminated: Bools  # (T, N) whether each of T steps ended the episode of a lane in a terminal state
    truncated: Bools  # (T, N) whether each of T steps ended the episode of a lane for another reason
    final_steps: Ints  # (K,) index of the last step of each of the K episodes that ended, in ascending order
    final_lanes: Ints  # (K,) lane of each of the K ended episodes
    final_observation: Floats  # (K, D) last observation, of D entries, of each of the K ended episodes
    model_version: Ints  # (T, N) version of the model that each of N lanes' episodes ran under in each of T steps
    reward_mean: Floats  # (T, N) reward in T steps of N lanes without the penalty for uncertainty
    # (T, N) whether a lane's episode ended in this step because the model is too uncertain there; None in a session
    # without the option ``trust``.
    untrusted: Bools | None = None
    # (T, N) whether a lane's episode ended early in this step: outside the sampling range, or where the model is too
    # uncertain, if a reward outside is declared; or where the fallback of declared limits acts. None if neither that
    # reward nor limits are declared.
    left: Bools | None = None

    def __len__(self) -> int:
        return len(self.reward)

    @classmethod
    def of(cls, steps: Sequence[StepResult], action: Floats, log_probability: Floats | None) -> Self:
        """Combine the results of one or more steps with the policy's actions (T, N, F) in these steps."""
        untrusted = [step.untrusted for step in steps if step.untrusted is not None]
        left = [step.left for step in steps if step.left is not None]
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
            left=np.stack(left) if len(left) == len(steps) else None,
        )

    def steps(self) -> list[StepResult]:
        """Return one result for each step, as ``SurrogatePort.step`` returns it. Its arrays are views of the
        rollout's."""
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
                left=None if self.left is None else self.left[t],
            )
            for t in range(len(self))
        ]


def quick(kind: type[T], **fields: Any) -> T:
    """Make an instance of a frozen dataclass from all its fields, in half the time of its constructor. Speed matters,
    because every virtual step makes two instances."""
    instance = object.__new__(kind)
    instance.__dict__.update(fields)
    return instance


@runtime_checkable
class SurrogatePort(Protocol):
    """One surrogate, as a trainer uses it.

    Every implementation obeys these laws. A step is taken once, however often the transport repeats its request, and
    each repeat gets the same reply, bit for bit. Results of a session depend only on its seed and its requests. An
    error has a class of the same name in ``surrogym_client.errors`` and ``surrogym_server.errors``.
    """

    def spec(self) -> EnvironmentSpec:
        """Return the specification of the original environment."""
        ...

    def open(self, request: OpenSession) -> SessionView:
        """Open a session, a virtual environment of N lanes, and return its description."""
        ...

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        """Start new episodes in all lanes, or only in those where ``mask`` (N,) is True."""
        ...

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        """Step all lanes, or only those where ``mask`` (N,) is True, with the actions (N, F) of the lanes."""
        ...

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        """Step all lanes T times with actions (T, N, F), in one request, and return the result of each step."""
        ...

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """Store the states that a session visited under the name ``checkpoint``, so that queries can be chosen near
        them.

        Returns how certain the model is at these states.
        """
        ...

    def close(self, session: str) -> None:
        """Close a session. Does nothing if the session is closed already."""
        ...


@runtime_checkable
class ModelPort(SurrogatePort, Protocol):
    """A surrogate whose model can be read."""

    def model_file(self) -> bytes:
        """Return the latest model as the content of a safetensors file."""
        ...


HORIZONS = (12, 25)  # smallest and largest default number of steps of each rollout of a planner


def horizon_of(spec: EnvironmentSpec) -> int:
    """Return the default number of steps of each rollout of a planner: a tenth of an episode, within ``HORIZONS``.

    An episode shows how fast a system is for its sampling period: a rotary pendulum at 50 Hz needs 25 steps."""
    least, most = HORIZONS
    return min(max((spec.time_limit or 0) // 10, least), most)


@runtime_checkable
class PlanningPort(SurrogatePort, Protocol):
    """A surrogate in this process, on whose model actions can be planned."""

    def planner(
        self,
        horizon: int,
        seed: int,
        set_points: Mapping[str, float] | None = None,
        limits: Sequence[str] = (),
        sensor_noise: Mapping[str, float] | None = None,
    ) -> Planning:
        """Return a function that plans each action by rollouts of ``horizon`` steps, in which it tries random changes
        of actions. ``set_points`` replaces set points of the declared reward, by coordinate. The plans keep ``limits``,
        inequalities that ``surrogym_shared.limits.limit_of`` reads. ``sensor_noise`` has standard deviations of
        measurements, by coordinate, and the function then filters what is measured."""
        ...


class Planning(Protocol):
    """Function that plans actions for N environments, from what was measured."""

    def __call__(self, observations: NDArray[np.floating[Any]], /) -> NDArray[Any]:
        """Return the actions for observations (N, D): (N, F), or (N,) if they are discrete."""
        ...

    def from_states(self, states: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the actions (N, F) for states (N, C). A discrete action is given by its number."""
        ...


@runtime_checkable
class PolicyPort(SurrogatePort, Protocol):
    """A surrogate that can also run a policy itself, so that a rollout of many steps is one request.

    Law: the result equals that of single steps of all lanes with the actions of ``surrogym_shared.acting.Actor``. The
    two are equal bit for bit if client and server have the same version of NumPy and the same kind of processor.
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
        """Let a policy act in all lanes for several steps, in one request. If an error is raised, no step was taken.

        Args:
            session: id of a session whose lanes have been reset.
            policy: the policy.
            steps: largest number of steps, T.
            noise: key of the random noise of the actions; None takes the most probable actions.
            until: mask (N,) of lanes; the rollout stops once an episode has ended in each of these lanes.
        """
        ...
