"""Gymnasium's classic control tasks as original environments."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.classic import PAPER_TASKS, TASKS, Task
from surrogym_sampler.original.errors import StepFailed
from surrogym_sampler.original.periods import period_of
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.spec.actions import Action


def task_for(environment: str, preset: str) -> Task:
    """Return the task with this Gymnasium id. With the preset ``paper``, it has the specification used in the paper, if
    that differs from the usual one.

    Raises:
        KeyError: there is no classic control task with this id.
    """
    if preset == "paper" and environment in PAPER_TASKS:
        return PAPER_TASKS[environment]
    return TASKS[environment]


def opens_task(name: str, spec: EnvironmentSpec | None) -> bool:
    """Return whether this module opens the environment of this name. The name must be that of a classic control task.
    If there is a specification, it must have the task's own coordinates in the same order; a drafted specification has
    others, and a simulator opens its environment."""
    return name in TASKS and (spec is None or spec.coordinate_names == TASKS[name].spec().coordinate_names)


def shows_the_same(spec: EnvironmentSpec) -> bool:
    """Return whether the specification's observation equals the environment's own, entry by entry."""
    return spec.environment in TASKS and TASKS[spec.environment].spec().observation == spec.observation


class GymnasiumEnvironment:
    """A classic control task that can be set to coordinates or reset. It is unwrapped, so it has no time limit."""

    parallel = True

    def __init__(self, spec: EnvironmentSpec) -> None:
        self._spec = spec
        self._task = task_for(spec.environment, spec.design.preset)
        self._env: Any = gymnasium.make(spec.environment).unwrapped
        self._env.reset(seed=0)
        self.period = period_of(self._env)
        self._shows_own = shows_the_same(spec)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Set the state to coordinates (C,), and apply an action (F,)."""
        self._task.write(self._env, coordinates)
        return self.act(action)

    def begin(self, seed: int | None = None) -> Array:
        """Reset the environment, and return its coordinates (C,)."""
        self._env.reset(seed=seed)
        return wrapped(self._spec, self._task.read(self._env))

    def act(self, action: Array) -> RealStep:
        """Apply an action (F,) in the current state."""
        achieved = wrapped(self._spec, self._task.read(self._env))
        native = native_action(self._spec.action, action)
        observation, reward, terminated, truncated, _ = self._env.step(native)
        return RealStep(
            coordinates=achieved,
            action=np.atleast_1d(np.asarray(native, dtype=np.float64)),
            next_coordinates=wrapped(self._spec, self._task.read(self._env)),
            reward=float(reward),
            terminated=bool(terminated and self._spec.termination),
            truncated=bool(truncated),
            next_observation=np.asarray(observation, dtype=np.float64) if self._shows_own else None,
        )

    def save(self) -> bytes:
        """Return the task's own state as a snapshot. It is exact: full turns of an angle, and all digits of a number,
        are kept."""
        return packed(np.asarray(self._env.state))

    def restore(self, snapshot: bytes) -> Array:
        """Return to a saved state, and return its coordinates (C,)."""
        state = unpacked(snapshot, np.shape(self._env.state))
        self._task.write(self._env, state)
        self._env.state = state
        return wrapped(self._spec, self._task.read(self._env))

    def parameters(self) -> dict[str, float]:
        """Return the task's physical attributes, by name."""
        return {name: float(getattr(self._env, name)) for name in self._task.perturbable}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Change physical attributes, and recompute those that depend on them."""
        for name, value in values.items():
            setattr(self._env, name, value)
        if self._task.settle is not None:
            self._task.settle(self._env)

    def close(self) -> None:
        self._env.close()


def native_action(space: Action, action: Array) -> Any:
    """Convert an action (F,) to the form that a Gymnasium environment's ``step`` takes: an int, or an array."""
    if isinstance(space, BoxAction):
        return np.asarray(action, dtype=np.float32)
    numbers = np.asarray(action, dtype=np.int64)
    return int(numbers[0]) if space.kind == "discrete" else numbers


def wrapped(spec: EnvironmentSpec, coordinates: Array) -> Array:
    """Wrap the angles of coordinates (..., C) to [-pi, pi), and clip bounded coordinates to their bounds.

    Environments with a float32 state exceed their own bounds by a rounding error.
    """
    out = np.array(coordinates, dtype=np.float64)
    for i, coordinate in enumerate(spec.coordinates):
        if coordinate.kind == "angle":
            out[..., i] = (out[..., i] + np.pi) % (2 * np.pi) - np.pi
        elif coordinate.bounds is not None:
            low = -np.inf if coordinate.bounds.low is None else coordinate.bounds.low
            high = np.inf if coordinate.bounds.high is None else coordinate.bounds.high
            out[..., i] = np.clip(out[..., i], low, high)
    return out


def packed(state: NDArray[Any]) -> bytes:
    """Return an array as the bytes of a snapshot, without loss of precision."""
    file = io.BytesIO()
    np.save(file, state, allow_pickle=False)
    return file.getvalue()


def unpacked(snapshot: bytes, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the array in a snapshot that ``packed`` made.

    Raises:
        StepFailed: the snapshot can't be read, or its array has another shape.
    """
    try:
        state: NDArray[Any] = np.load(io.BytesIO(snapshot), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise StepFailed(
            f"expected a snapshot with an array of shape {shape}, got a snapshot that can't be read ({error}): delete "
            "it"
        ) from error
    if state.shape != shape:
        raise StepFailed(
            f"expected a snapshot with an array of shape {shape}, got {state.shape}: delete the snapshots of this "
            "environment"
        )
    return state
