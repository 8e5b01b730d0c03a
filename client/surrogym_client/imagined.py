"""Imagined return: what a policy earns in the surrogate, from the declared starts and without exploration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_shared.port import SurrogatePort

LONGEST_EPISODE = 1_000  # where the specification has no time limit


def imagined_returns(
    port: SurrogatePort,
    predict: Callable[[NDArray[Any]], NDArray[Any]],
    episodes: int,
    seed: int,
    **options: Any,
) -> NDArray[np.float64]:
    """Undiscounted returns (episodes,) of whole virtual episodes side by side, any penalty included.

    Args:
        port: the surrogate.
        predict: observations (N, D) to actions.
        episodes: how many.
        seed: of their starts; the same seed compares policies on the same starts.
        options: further fields of ``OpenSession``.
    """
    env = SurrogateVecEnv.from_port(port, episodes, seed=seed, **(options | {"start_box": 0.0}))
    returns, running = np.zeros(episodes), np.ones(episodes, dtype=bool)
    try:
        observation: Any = env.reset()
        for _ in range(port.spec().time_limit or LONGEST_EPISODE):
            observation, reward, done, _ = env.step(predict(observation))
            returns += np.where(running, reward, 0.0)
            running &= ~done
            if not running.any():
                break
    finally:
        env.close()
    return returns
