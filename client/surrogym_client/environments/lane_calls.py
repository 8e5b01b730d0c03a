"""Collect the calls of single lanes into one request, for libraries that step each lane separately."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.env import Observation, start_info, step_info
from surrogym_client.environments.lanes import Lanes
from surrogym_shared.port import Bools

Started = tuple[Observation, dict[str, Any]]
Stepped = tuple[Observation, float, bool, bool, dict[str, Any]]


class LaneCalls:
    """Collects resets and steps of single lanes, and sends them in one request when the first answer is read.

    Args:
        lanes: lanes of a session with autoreset disabled; the library that calls each lane also resets it.
    """

    def __init__(self, lanes: Lanes) -> None:
        self._lanes = lanes
        self._seeds: dict[int, int | None] = {}
        self._actions: dict[int, NDArray[Any]] = {}
        self._answers: dict[int, Started | Stepped] = {}

    def reset(self, lane: int, seed: int | None = None) -> None:
        """Start a new episode in a lane. Without a seed, the lane's next episode begins."""
        self._seeds[lane] = seed

    def step(self, lane: int, action: Any) -> None:
        """Step a lane with an action: an array (F,), or a number."""
        self._actions[lane] = np.asarray(action)

    def answer(self, lane: int) -> Started | Stepped:
        """Return what ``Env.reset`` or ``Env.step`` returns for the lane's last call.

        Raises:
            SurrogymClientError: as ``Lanes``; the collected calls are then discarded.
        """
        if lane not in self._answers:
            self._send()
        return self._answers.pop(lane)

    def _send(self) -> None:
        (seeds, self._seeds), (actions, self._actions) = (self._seeds, {}), (self._actions, {})
        if seeds:
            self._answers |= self._start(seeds)
        if actions:
            self._answers |= self._move(actions)

    def _start(self, seeds: dict[int, int | None]) -> dict[int, Started | Stepped]:
        start = self._lanes.reset([seeds.get(lane) for lane in range(self._lanes.num_envs)], self._mask(seeds))
        return {lane: (start.observation[lane], start_info(start, lane)) for lane in seeds}

    def _move(self, actions: dict[int, NDArray[Any]]) -> dict[int, Started | Stepped]:
        idle = np.zeros_like(next(iter(actions.values())))
        step = self._lanes.step(
            np.stack([actions.get(lane, idle) for lane in range(self._lanes.num_envs)]), self._mask(actions)
        )
        result = step.result
        return {
            lane: (
                result.observation[lane],
                float(result.reward[lane]),
                bool(result.terminated[lane]),
                bool(result.truncated[lane]),
                step_info(step, lane),
            )
            for lane in actions
        }

    def _mask(self, called: dict[int, Any]) -> Bools | None:
        mask = np.zeros(self._lanes.num_envs, dtype=bool)
        mask[list(called)] = True
        return None if mask.all() else mask
