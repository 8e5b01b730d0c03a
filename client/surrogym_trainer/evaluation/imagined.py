"""Runs of policies in the surrogate without training: imagined returns, and statistics of observations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.acting import ActingLanes
from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.acting import ActingPolicy
from surrogym_shared.network import Network, bounds_of
from surrogym_shared.port import PolicyPort, PolicyRollout, StepResult, SurrogatePort

# session options with which every episode begins where the specification declares
DECLARED = {"start_box": 0.0, "start_visited": 0.0}
# session options of whole episodes; none ends where the model is unsure (trust), because a shortened episode would earn
# more if rewards are costs
WHOLE = {**DECLARED, "trust": None}
# session options if the specification declares a reward outside the trusted states: an episode may end there, because
# it gets this reward for each missing step
PAID_OUTSIDE = DECLARED
STATISTICS_LANES = 1_024
# largest number of steps that one request to the server takes; a longer episode needs several requests
STEPS_AT_ONCE = 1_000


@dataclass(frozen=True)
class Imagined:
    """The returns and the penalties of whole virtual episodes."""

    returns: NDArray[np.float64]  # (episodes,) undiscounted returns, less the penalties for uncertainty
    penalty_share: float  # sum of the penalties for uncertainty, as a share of the sum of absolute rewards
    episode_penalty: float | None  # mean penalty for uncertainty in an episode; None if the session has no penalty
    # (episodes,) whether each episode ended early: outside the sampling range, or where the model is too uncertain, if
    # a reward outside is declared; or where the fallback of declared limits acts. None if neither that reward nor
    # limits are declared.
    left: NDArray[np.bool_] | None = None


def imagined_returns(
    port: SurrogatePort,
    predict: Callable[[NDArray[Any]], NDArray[Any]],
    episodes: int,
    seed: int | Sequence[int],
    **options: Any,
) -> NDArray[np.float64]:
    """Return the returns (episodes,) of virtual episodes, as ``imagine`` does.

    The imagined return of a policy is their mean: from the declared starts, without exploration.
    """
    return imagine(port, predict, episodes, seed, **options).returns


def imagine(
    port: SurrogatePort,
    predict: Callable[[NDArray[Any]], NDArray[Any]],
    episodes: int,
    seed: int | Sequence[int],
    **options: Any,
) -> Imagined:
    """Run a policy through whole virtual episodes side by side, from the declared starts.

    If the server loses the session, all episodes begin again, because shortened ones would earn more if rewards are
    costs. A ``Network`` acts on the surrogate's side if that is supported, with the same returns.

    Args:
        port: the interface of the surrogate.
        predict: function from observations (N, D) to actions.
        episodes: number of episodes.
        seed: seed of their starts, or one for each episode; the same seed compares policies on the same starts.
        options: further fields of ``OpenSession``.
    """
    whole = WHOLE if port.spec().outside_reward is None else PAID_OUTSIDE
    lanes = Lanes(port, session_request(episodes, "same_step", options | whole))
    sums, limit = _Sums(episodes), port.spec().time_limit or LONGEST_EPISODE
    policy = _as_arrays(predict, port)
    try:
        taken = _stepped(lanes, predict, seed) if policy is None else _rolled(lanes, policy, seed, sums)
        for part in taken:
            if part is None:
                return imagine(port, predict, episodes, seed, **options)
            sums.add(part)
            if sums.steps >= limit or not sums.running.any():
                break
    finally:
        lanes.close()
    penalised = lanes.penalised
    share = float(np.abs(sums.penalties).sum()) / sums.size if penalised and sums.size else 0.0
    return Imagined(sums.returns, share, float(sums.penalties.mean()) if penalised else None, sums.left)


class _Sums:
    """The sums of returns and penalties over the first episode of each lane so far."""

    def __init__(self, episodes: int) -> None:
        self.returns, self.penalties = np.zeros(episodes), np.zeros(episodes)
        self.running = np.ones(episodes, dtype=bool)
        self.left: NDArray[np.bool_] | None = None
        self.size = 0.0
        self.steps = 0

    def add(self, taken: _Rewards) -> None:
        ended = np.logical_or.accumulate(taken.ended)
        running = self.running & np.concatenate([np.ones_like(ended[:1]), ~ended[:-1]])
        self.returns = _added(self.returns, np.where(running, taken.reward, 0.0))
        self.penalties = _added(self.penalties, np.where(running, taken.mean - taken.reward, 0.0))
        self.size += float(np.abs(taken.mean[running]).sum())
        if taken.left is not None:
            left = (taken.left & running).any(0)
            self.left = left if self.left is None else self.left | left
        self.running = self.running & ~ended[-1]
        self.steps += len(ended)


class _Rewards(NamedTuple):
    """The results of T steps in N lanes, (T, N) each: rewards less the penalty, rewards without the penalty, and
    whether the step ended its episode; ``left`` is whether the episode ended outside the sampling range or where the
    fallback acts, or None."""

    reward: NDArray[np.floating[Any]]
    mean: NDArray[np.floating[Any]]
    ended: NDArray[np.bool_]
    left: NDArray[np.bool_] | None

    @classmethod
    def of(cls, result: StepResult | PolicyRollout) -> Self:
        ended = result.terminated | result.truncated
        left = None if result.left is None else np.atleast_2d(result.left)
        return cls(np.atleast_2d(result.reward), np.atleast_2d(result.reward_mean), np.atleast_2d(ended), left)


def _stepped(
    lanes: Lanes, predict: Callable[[NDArray[Any]], NDArray[Any]], seed: int | Sequence[int]
) -> Iterator[_Rewards | None]:
    """Take steps one by one, and yield their rewards; None if the session was lost."""
    observation = lanes.reset(seed).observation
    while True:
        step = lanes.step(predict(observation))
        observation = step.result.observation
        yield _Rewards.of(step.result) if step.lost is None else None


def _rolled(lanes: Lanes, policy: ActingPolicy, seed: int | Sequence[int], sums: _Sums) -> Iterator[_Rewards | None]:
    """Take many steps in each request, and yield their rewards; None if the session was lost."""
    acting, limit = ActingLanes(lanes), lanes.port.spec().time_limit or LONGEST_EPISODE
    acting.reset(seed)
    while True:
        taken = acting.take(policy, min(limit - sums.steps, STEPS_AT_ONCE), until=sums.running)
        yield None if taken.cut.any() else _Rewards.of(taken.rollout)


def _as_arrays(predict: Callable[[NDArray[Any]], NDArray[Any]], port: SurrogatePort) -> ActingPolicy | None:
    """Return the policy in the form of arrays, so that it can act inside the surrogate. None if the policy has no such
    form, or if its action bounds are not those of the surrogate."""
    if not isinstance(predict, Network) or not isinstance(port, PolicyPort):
        return None
    spec = port.spec()
    same = all(map(np.array_equal, (predict.low, predict.high), bounds_of(spec)))
    if predict.counts != spec.action.policy_counts or not (same or predict.counts):
        return None
    try:
        return ActingPolicy.of(predict)
    except ValueError:
        # A network that is too large, or of a form that ActingPolicy can't hold, acts step by step in this process.
        return None


def _added(sums: NDArray[np.float64], rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return sums (N,) with rows (T, N) added one row at a time, so that rounding does not depend on T."""
    added: NDArray[np.float64] = np.cumsum(np.concatenate([sums[None], rows]), axis=0)[-1]
    return added


def observation_statistics(port: SurrogatePort, seed: int) -> tuple[list[float], list[float]]:
    """Return the mean (D,) and the standard deviation (D,) of observations over the sampling range."""
    lanes = Lanes(port, session_request(STATISTICS_LANES, "same_step", {"start_box": 1.0}))
    try:
        observation = np.asarray(lanes.reset(seed).observation, dtype=np.float64)
    finally:
        lanes.close()
    deviation = observation.std(0)
    return observation.mean(0).tolist(), np.where(deviation > 1e-6, deviation, 1.0).tolist()
