"""What a surrogate says of a policy, and of the observations it will see, without training."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.acting import ActingLanes
from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.original.protocol import LONGEST_EPISODE
from surrogym_shared.acting import ActingPolicy
from surrogym_shared.network import Network, bounds_of, counts_of
from surrogym_shared.port import PolicyPort, PolicyRollout, StepResult, SurrogatePort

WHOLE = {"start_box": 0.0, "trust": None}  # an episode cut short would earn more where rewards are costs
PAID_OUTSIDE = {"start_box": 0.0}  # an episode that leaves what is trusted pays for what it lacks
STATISTICS_LANES = 1_024
STEPS_AT_ONCE = 1_000  # of an imagined episode: a bound on a reply, not on an episode


@dataclass(frozen=True)
class Imagined:
    """Whole virtual episodes."""

    returns: NDArray[np.float64]  # (episodes,) undiscounted, any penalty included
    penalty_share: float  # of the reward's size
    episode_penalty: float | None  # what it takes off a return, mean; None in a session without


def imagined_returns(
    port: SurrogatePort,
    predict: Callable[[NDArray[Any]], NDArray[Any]],
    episodes: int,
    seed: int | Sequence[int],
    **options: Any,
) -> NDArray[np.float64]:
    """The returns (episodes,) of ``imagine``. The imagined return of a policy is their mean: from the declared starts,
    without exploration."""
    return imagine(port, predict, episodes, seed, **options).returns


def imagine(
    port: SurrogatePort,
    predict: Callable[[NDArray[Any]], NDArray[Any]],
    episodes: int,
    seed: int | Sequence[int],
    **options: Any,
) -> Imagined:
    """Let a policy run through whole virtual episodes side by side, from the declared starts.

    Where the server loses the session they begin anew: cut short, they would earn more where rewards are costs.
    A ``Network`` acts on the surrogate's side where that can, to the same returns.

    Args:
        port: the surrogate.
        predict: observations (N, D) to actions.
        episodes: how many.
        seed: of their starts, or one an episode; the same seed compares policies on the same starts.
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
    penalised = lanes.view.penalty > 0
    share = float(np.abs(sums.penalties).sum()) / sums.size if penalised and sums.size else 0.0
    return Imagined(sums.returns, share, float(sums.penalties.mean()) if penalised else None)


class _Sums:
    """What the first episode of each lane earned so far."""

    def __init__(self, episodes: int) -> None:
        self.returns, self.penalties = np.zeros(episodes), np.zeros(episodes)
        self.running = np.ones(episodes, dtype=bool)
        self.size = 0.0
        self.steps = 0

    def add(self, taken: _Rewards) -> None:
        ended = np.logical_or.accumulate(taken.ended)
        running = self.running & np.concatenate([np.ones_like(ended[:1]), ~ended[:-1]])
        self.returns = _added(self.returns, np.where(running, taken.reward, 0.0))
        self.penalties = _added(self.penalties, np.where(running, taken.mean - taken.reward, 0.0))
        self.size += float(np.abs(taken.mean[running]).sum())
        self.running = self.running & ~ended[-1]
        self.steps += len(ended)


class _Rewards(NamedTuple):
    """Of T steps, (T, N) each."""

    reward: NDArray[np.floating[Any]]
    mean: NDArray[np.floating[Any]]
    ended: NDArray[np.bool_]

    @classmethod
    def of(cls, result: StepResult | PolicyRollout) -> Self:
        ended = result.terminated | result.truncated
        return cls(np.atleast_2d(result.reward), np.atleast_2d(result.reward_mean), np.atleast_2d(ended))


def _stepped(
    lanes: Lanes, predict: Callable[[NDArray[Any]], NDArray[Any]], seed: int | Sequence[int]
) -> Iterator[_Rewards | None]:
    """Steps one by one; None where the session was lost."""
    observation = lanes.reset(seed).observation
    while True:
        step = lanes.step(predict(observation))
        observation = step.result.observation
        yield _Rewards.of(step.result) if step.lost is None else None


def _rolled(lanes: Lanes, policy: ActingPolicy, seed: int | Sequence[int], sums: _Sums) -> Iterator[_Rewards | None]:
    """Many steps at once, as long as an episode runs; None where the session was lost."""
    acting, limit = ActingLanes(lanes), lanes.port.spec().time_limit or LONGEST_EPISODE
    acting.reset(seed)
    while True:
        taken = acting.take(policy, min(limit - sums.steps, STEPS_AT_ONCE), until=sums.running)
        yield None if taken.cut.any() else _Rewards.of(taken.rollout)


def _as_arrays(predict: Callable[[NDArray[Any]], NDArray[Any]], port: SurrogatePort) -> ActingPolicy | None:
    """A policy that the surrogate's side can act by; None for what is none, or acts within other bounds."""
    if not isinstance(predict, Network) or not isinstance(port, PolicyPort):
        return None
    spec = port.spec()
    same = all(map(np.array_equal, (predict.low, predict.high), bounds_of(spec)))
    if predict.counts != counts_of(spec) or not (same or predict.counts):
        return None
    try:
        return ActingPolicy.of(predict)
    except ValueError:
        return None  # several policies at once, or one beyond the limits


def _added(sums: NDArray[np.float64], rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Sums (N,) and rows (T, N), added one after the other: to the same bits for any T."""
    added: NDArray[np.float64] = np.cumsum(np.concatenate([sums[None], rows]), axis=0)[-1]
    return added


def observation_statistics(port: SurrogatePort, seed: int) -> tuple[list[float], list[float]]:
    """Mean and deviation, (D,) each, of observations over the sampling range."""
    lanes = Lanes(port, session_request(STATISTICS_LANES, "same_step", {"start_box": 1.0}))
    try:
        observation = np.asarray(lanes.reset(seed).observation, dtype=np.float64)
    finally:
        lanes.close()
    deviation = observation.std(0)
    return observation.mean(0).tolist(), np.where(deviation > 1e-6, deviation, 1.0).tolist()
