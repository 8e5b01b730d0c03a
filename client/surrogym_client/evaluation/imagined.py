"""What a surrogate says of a policy, and of the observations it will see, without training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.original.protocol import LONGEST_EPISODE
from surrogym_shared.port import SurrogatePort

WHOLE = {"start_box": 0.0, "trust": None}  # an episode cut short would earn more where rewards are costs
STATISTICS_LANES = 1_024


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

    Args:
        port: the surrogate.
        predict: observations (N, D) to actions.
        episodes: how many.
        seed: of their starts, or one an episode; the same seed compares policies on the same starts.
        options: further fields of ``OpenSession``.
    """
    lanes = Lanes(port, session_request(episodes, "same_step", options | WHOLE))
    returns, penalties, running = np.zeros(episodes), np.zeros(episodes), np.ones(episodes, dtype=bool)
    size = 0.0
    try:
        penalised = lanes.view.penalty > 0
        observation = lanes.reset(seed).observation
        for _ in range(port.spec().time_limit or LONGEST_EPISODE):
            step = lanes.step(predict(observation))
            if step.lost is not None:
                return imagine(port, predict, episodes, seed, **options)
            result = step.result
            observation = result.observation
            returns += np.where(running, result.reward, 0.0)
            penalties += np.where(running, result.reward_mean - result.reward, 0.0)
            size += float(np.abs(result.reward_mean[running]).sum())
            running &= ~(result.terminated | result.truncated)
            if not running.any():
                break
    finally:
        lanes.close()
    share = float(np.abs(penalties).sum()) / size if penalised and size else 0.0
    return Imagined(returns, share, float(penalties.mean()) if penalised else None)


def observation_statistics(port: SurrogatePort, seed: int) -> tuple[list[float], list[float]]:
    """Mean and deviation, (D,) each, of observations over the sampling range."""
    lanes = Lanes(port, session_request(STATISTICS_LANES, "same_step", {"start_box": 1.0}))
    try:
        observation = np.asarray(lanes.reset(seed).observation, dtype=np.float64)
    finally:
        lanes.close()
    deviation = observation.std(0)
    return observation.mean(0).tolist(), np.where(deviation > 1e-6, deviation, 1.0).tolist()
