"""Types of policies and controllers: functions from observations to actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Predict = Callable[[NDArray[np.float32]], NDArray[Any]]
"""A policy: a function from observations (N, D) to actions (N,) or (N, F)."""


class PerEpisode(ABC):
    """A controller that may have a memory for each episode, so it needs to know the episode of each observation."""

    @abstractmethod
    def actions(self, episodes: Sequence[int], observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions (N, F) for observations (N, D) of N different episodes, which are identified by
        their numbers."""


Acting = Predict | PerEpisode
