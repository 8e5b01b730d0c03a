"""The adapter for tasks of the DeepMind Control Suite, named ``dm_control:DOMAIN-TASK``."""

from __future__ import annotations

import os
import re
from typing import Any

import numpy as np

from surrogym_sampler.original.adapters.parts import OfParts, flat
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulator, Taken
from surrogym_sampler.original.state_parts import mujoco_parts
from surrogym_shared.spec import BoxAction

NAME = re.compile(r"dm_control:([a-z0-9_]+)-([a-z0-9_]+)")


def open_simulator(name: str) -> Simulator:
    """Open a task named ``dm_control:DOMAIN-TASK``.

    Raises:
        UnknownEnvironment: there is no such task, or dm_control does not work with the installed MuJoCo.
        ImportError: dm_control is not installed.
    """
    os.environ.setdefault("MUJOCO_GL", "disable")  # rendering is not needed, and the machine may have no display
    try:
        from dm_control import suite
    except ImportError:
        raise
    except Exception as error:  # dm_control 1.0.50 raises an AttributeError with MuJoCo 4
        raise UnknownEnvironment(
            f"dm_control does not work with the installed version of MuJoCo ({type(error).__name__}: {error}): "
            "pip install 'surrogym[dm-control]' in a separate Python environment"
        ) from error
    match = NAME.fullmatch(name)
    if match is None or match.groups() not in suite.ALL_TASKS:
        raise UnknownEnvironment(
            f"expected dm_control:DOMAIN-TASK, such as dm_control:cartpole-swingup, got {name!r}"
            + _tasks_of(suite.ALL_TASKS, match.group(1) if match else "")
        )
    return ControlSuite(name, suite.load(*match.groups(), task_kwargs={"random": 0}))


def _tasks_of(tasks: Any, domain: str) -> str:
    known = [f"{of}-{task}" for of, task in tasks if of == domain]
    return f": expected one of {', '.join(known)}" if known else ""


class ControlSuite(OfParts):
    """One task of the DeepMind Control Suite. Its step does what ``control.Environment.step`` does, but counts no steps
    and so never ends by the time limit."""

    def __init__(self, name: str, env: Any) -> None:
        self._name, self._env = name, env
        self._physics, self._task = env.physics, env.task
        model, data = self._physics.model.ptr, self._physics.data.ptr
        super().__init__(mujoco_parts(model, data, self.reset), model, data)
        self.period = float(env.control_timestep())
        self._substeps = round(env.control_timestep() / self._physics.timestep())
        bounds = env.action_spec()
        self.action = BoxAction(low=tuple(map(float, bounds.minimum)), high=tuple(map(float, bounds.maximum)))
        limit = float(env._step_limit)  # dm_control has no public attribute for the time limit
        self.time_limit = round(limit) if np.isfinite(limit) else None

    def reset(self, seed: int | None) -> Array:
        if seed is not None:
            self._task.random.seed(seed)
        return self._flat(self._env.reset().observation)

    def step(self, action: Array) -> Taken:
        task, physics = self._task, self._physics
        task.before_step(np.asarray(action, dtype=np.float64), physics)
        physics.step(self._substeps)
        task.after_step(physics)
        discount = task.get_termination(physics)
        return Taken(self.observe(), float(task.get_reward(physics)), discount == 0.0, discount not in (None, 0.0))

    def observe(self) -> Array:
        return self._flat(self._task.get_observation(self._physics))

    def close(self) -> None:
        self._env.close()

    def action_taken(self, action: Array) -> Array:
        return np.array(action, dtype=np.float64)

    def _flat(self, observation: Any) -> Array:
        return np.concatenate([flat(self._name, np.ravel(entry)) for entry in observation.values()])
