"""Environments that an adapter opens by name, and one whose state is an attribute."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import gymnasium
import numpy as np
import pytest

Register = Callable[..., str]  # registers an environment of Gymnasium, and gives its name back

NAMES = {
    "mujoco": ["Swimmer-v5", "Hopper-v5", "HalfCheetah-v5", "Walker2d-v5", "Pusher-v5", "Reacher-v5"],
    "dm_control": ["dm_control:pendulum-swingup", "dm_control:cartpole-swingup", "dm_control:reacher-easy"],
    "gymnasium_robotics": ["gymnasium_robotics:PointMaze_UMaze-v3", "gymnasium_robotics:FetchReach-v4"],
    "pcgym": ["pcgym:cstr"],
}


def installed(package: str) -> pytest.MarkDecorator:
    lacks = not find_spec(package)
    return pytest.mark.skipif(lacks, reason=f"{package} is not installed here: make test-all has it in .venv-adapters")


CASES = [pytest.param(name, marks=installed(package)) for package, names in NAMES.items() for name in names]


class Spiral(gymnasium.Env):
    """A machine whose state is an attribute; it remembers ``wear`` besides, if it is told to."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-10, 10, (2,))

    def __init__(self, attribute: str = "state", wear: float = 0.0) -> None:
        self._attribute, self._wear = attribute, wear

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._worn = 0.0
        setattr(self, self._attribute, self.np_random.uniform(-1, 1, 2))
        return getattr(self, self._attribute).astype(np.float32), {}

    def step(self, action):
        x, y = getattr(self, self._attribute)
        self._worn += self._wear
        setattr(self, self._attribute, np.array([0.9 * x - 0.1 * y, 0.1 * x + 0.9 * y + 0.1 * action[0] + self._worn]))
        shown = getattr(self, self._attribute)
        return shown.astype(np.float32), -float(shown @ shown), False, False, {}
