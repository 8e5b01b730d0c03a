"""Gymnasium's MuJoCo environments as original environments: coordinates are joint positions and velocities.

A coordinate is named after its joint, or ``<joint>_velocity``. What is not named stays as the model starts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surrogym_client.original.errors import UnknownEnvironment
from surrogym_client.original.gymnasium import native_action, wrapped
from surrogym_client.original.mujoco_tasks import SPECIFICATIONS
from surrogym_client.original.protocol import Array, Native, RealStep
from surrogym_shared.spec import EnvironmentSpec

VELOCITY = "_velocity"


def is_known(name: str) -> bool:
    """Whether this is one of Gymnasium's own MuJoCo ids; finding out imports nothing else."""
    import gymnasium

    entry = gymnasium.registry.get(name)
    return entry is not None and str(entry.entry_point).startswith("gymnasium.envs.mujoco.")


def specification(name: str) -> EnvironmentSpec:
    """The built-in specification of a MuJoCo id.

    Raises:
        UnknownEnvironment: there is none; a person has to write one.
    """
    if name not in SPECIFICATIONS:
        raise UnknownEnvironment(
            f"{name} has no built-in specification: expected one of {', '.join(SPECIFICATIONS)}, "
            "or a specification file (surrogym_client.original.recognise helps to write one)"
        )
    return SPECIFICATIONS[name]()


class MujocoEnvironment:
    """Any Gymnasium environment with ``set_state(qpos, qvel)``, set to given coordinates or reset."""

    parallel = True

    def __init__(self, name: str, spec: EnvironmentSpec) -> None:
        self._spec = spec
        self._env = open_mujoco(name)
        self._joints = Joints(self._env)
        self._columns = self._joints.columns(spec.coordinate_names)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Set positions and velocities to coordinates (C,), apply action (F,)."""
        self._joints.write(self._columns, coordinates)
        return self.act(action)

    def begin(self, seed: int | None = None) -> Array:
        """Reset the environment; the coordinates (C,) it starts at."""
        self._env.reset(seed=seed)
        return wrapped(self._spec, self._joints.read(self._columns))

    def act(self, action: Array) -> RealStep:
        """Apply action (F,) where the environment stands."""
        achieved = wrapped(self._spec, self._joints.read(self._columns))
        native = native_action(self._spec, action)
        observation, reward, terminated, truncated, _ = self._env.step(native)
        return RealStep(
            coordinates=achieved,
            action=np.atleast_1d(np.asarray(native, dtype=np.float64)),
            next_coordinates=wrapped(self._spec, self._joints.read(self._columns)),
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            next_observation=np.asarray(observation, dtype=np.float64),
        )

    def close(self) -> None:
        self._env.close()


def open_mujoco(name: str) -> Native:
    """The unwrapped environment, after a first reset.

    Raises:
        UnknownEnvironment: MuJoCo is not installed, or the environment has no ``set_state``.
    """
    import gymnasium

    try:
        env: Any = gymnasium.make(name).unwrapped
    except (ImportError, gymnasium.error.Error) as error:
        raise UnknownEnvironment(f"{name} can't be made: {error} (pip install 'surrogym[mujoco]')") from error
    if not hasattr(env, "set_state"):
        raise UnknownEnvironment(f"{name} has no set_state(qpos, qvel)")
    env.reset(seed=0)
    return env


class Joints:
    """The joints of one model, and where each stands in the state vector (qpos, qvel)."""

    def __init__(self, env: Native) -> None:
        self._env = env
        model = env.model
        self.names = tuple(model.joint(i).name or f"joint{i}" for i in range(model.njnt))
        if model.nq != model.njnt or model.nv != model.njnt:
            raise UnknownEnvironment("free and ball joints can't be expressed: expected hinges and slides only")
        self._rest = np.concatenate([env.init_qpos, env.init_qvel])

    def columns(self, coordinates: tuple[str, ...]) -> list[int]:
        """Index into the state vector of each coordinate."""
        known = [*self.names, *(name + VELOCITY for name in self.names)]
        unknown = [name for name in coordinates if name not in known]
        if unknown:
            raise UnknownEnvironment(f"coordinates {unknown} are no joints of the model: expected some of {known}")
        return [known.index(name) for name in coordinates]

    def write(self, columns: list[int], coordinates: Array) -> None:
        """Put coordinates into the model; the solver's memory of earlier steps is cleared."""
        import mujoco

        state = self._rest.copy()
        state[columns] = coordinates
        mujoco.mj_resetData(self._env.model, self._env.data)
        self._env.set_state(state[: len(self.names)], state[len(self.names) :])

    def read(self, columns: list[int]) -> Array:
        state: Array = self._env.state_vector()
        return state[columns]
