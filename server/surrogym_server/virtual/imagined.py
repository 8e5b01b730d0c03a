"""Imagined episodes from a given state under given actions: one along the mean, and some along sampled functions.

Shapes: C coordinates, F action entries, T actions, K sampled functions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual.environment import VirtualSettings, create, step
from surrogym_server.virtual.lanes import RUNNING

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImaginedEpisode:
    # (t + 1, C) coordinates of the start and after each of t steps. There is a step for each action, or fewer if the
    # episode terminated before.
    coordinates: Array
    reward: NDArray[np.floating[Any]]  # (t,) reward of each of the episode's t steps
    terminated: bool


@dataclass(frozen=True)
class Imagined:
    mean: ImaginedEpisode
    draws: tuple[ImaginedEpisode, ...]


def imagine(model: DynamicsModel, q: Array, u: Array, *, draws: int, seed: int) -> Imagined:
    """Predict episodes from the state q (C,) under the actions u (T, F): one with mean predictions, and others along
    sampled functions.

    Args:
        model: the model.
        q, u: first state, and actions in the form in which the model takes them.
        draws: number of episodes along functions sampled from the posterior, K.
        seed: seed with which the functions are sampled.
    """
    mean = _episodes(model, VirtualSettings(1, autoreset_mode="disabled"), q, u, seed)[0]
    if not draws:
        return Imagined(mean, ())
    settings = VirtualSettings(draws, variant="pathwise", autoreset_mode="disabled")
    return Imagined(mean, _episodes(model, settings, q, u, seed))


def _episodes(
    model: DynamicsModel, settings: VirtualSettings, q: Array, u: Array, seed: int
) -> tuple[ImaginedEpisode, ...]:
    count = settings.num_envs
    lanes = create(model.definition, settings, seed)
    lanes = replace(
        lanes,
        q=torch.from_numpy(q).repeat(count, 1),
        phase=np.full_like(lanes.phase, RUNNING),
        episode=np.zeros_like(lanes.episode),
    )
    states, rewards, running = [lanes.q.numpy()], [], np.ones(count, dtype=bool)
    length = np.zeros(count, dtype=np.int64)
    for action in u:
        if not running.any():
            break
        lanes, moved = step(model, settings, lanes, np.tile(action, (count, 1)), running)
        length += running
        running = running & ~moved.terminated
        states.append(lanes.q.numpy())
        rewards.append(moved.reward)
    path, reward = np.stack(states, 1), np.stack(rewards, 1)
    return tuple(
        ImaginedEpisode(path[lane, : length[lane] + 1], reward[lane, : length[lane]], bool(not running[lane]))
        for lane in range(count)
    )
