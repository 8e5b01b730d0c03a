"""The adapter for Gymnasium environments, named by their id.

Their state is MuJoCo's, or the attribute ``state``. An environment with neither can only be reset. The goal of a goal
environment (Gymnasium-Robotics) is a part of the state, in its attribute ``goal``.
"""

from __future__ import annotations

import inspect
import os
import sys
from typing import Any

import gymnasium
import numpy as np

from surrogym_sampler.original.adapters.parts import OfParts, action_of, flat
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.gymnasium import native_action
from surrogym_sampler.original.periods import period_of
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulator, Taken, Variable
from surrogym_sampler.original.state_parts import (
    Attribute,
    StatePart,
    holds_numbers,
    mujoco_parts,
)

# If a server names an environment of this package, it is opened without asking the user. So only an installed package
# is used: the working directory is not searched.
ROBOTICS = "gymnasium_robotics"
# Observation spaces that can't be used, because their values are not numbers that change gradually.
SYMBOLS = ("Discrete", "MultiDiscrete", "MultiBinary", "Text", "Graph", "Sequence")
STEP = ("observation", "reward", "terminated", "truncated", "info")


def open_simulator(name: str) -> Simulator:
    """Open the Gymnasium environment with this id.

    Raises:
        UnknownEnvironment: the environment can't be made, or its spaces can't be used.
    """
    env = make(name)
    if type(env.observation_space).__name__ in SYMBOLS:
        raise UnknownEnvironment(
            f"{name} observes {env.observation_space}, a discrete observation: expected numbers that change "
            "gradually; write a class that gives such numbers (docs/how-to/own-environment.md)"
        )
    limit = env.spec.max_episode_steps
    # wrappers may change observations and rewards, so the unwrapped environment is not used
    wrapped = getattr(env.spec, "additional_wrappers", ())
    simulator = None if wrapped else settable(name, env.unwrapped, limit)
    return simulator or ResetOnly(name, env, limit)


def settable(name: str, env: Any, limit: int | None = None) -> GymnasiumSimulator | None:
    """Return a simulator of an unwrapped environment that can be set to a state; None if its state can't be read.
    ``limit`` is the largest number of steps in an episode, None for no limit."""
    if hasattr(env, "model") and hasattr(env, "data"):
        return GymnasiumSimulator(name, env, _mujoco(env), env.model, env.data, limit=limit)
    if holds_numbers(env, "state"):
        return GymnasiumSimulator(name, env, [Attribute(env, "state")], limit=limit)
    return None


def make(name: str) -> Any:
    """Make a Gymnasium environment, and reset it once. In ``package:Id-v0``, the package may be in the working
    directory.

    Raises:
        UnknownEnvironment: the environment can't be made.
    """
    package, colon, _ = name.partition(":")
    if colon and package != ROBOTICS and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        env: Any = gymnasium.make(name, disable_env_checker=True)
    except (ImportError, gymnasium.error.Error) as error:
        raise UnknownEnvironment(f"{name} can't be made: {error} {_way_out(name)}") from error
    env.reset(seed=0)
    return env


def _way_out(name: str) -> str:
    package = name.partition(":")[0]
    if package == ROBOTICS:
        return "(pip install 'surrogym[robotics]')"
    entry = gymnasium.registry.get(name)
    if entry is not None and str(entry.entry_point).startswith("gymnasium.envs.mujoco"):
        return "(pip install 'surrogym[mujoco]')"
    return "(an id of another package is written package:Id-v0)"


class _Gymnasium(Simulator):
    """Base class of simulators that reset and step a Gymnasium environment, and keep its latest observation."""

    def __init__(self, name: str, env: Any, limit: int | None) -> None:
        self._name, self._env, self._over = name, env, False
        self.action = action_of(name, env.action_space)
        self.shown_limits = _limits_of(env.observation_space)
        self.time_limit = limit
        self.period = period_of(env.unwrapped)

    def reset(self, seed: int | None) -> Array:
        observation, _ = _entries(self._env.reset(seed=seed), "the environment's reset", ("observation", "info"))
        self._last, self._over = flat(self._name, observation), False
        return self._last

    def step(self, action: Array) -> Taken:
        given = self._env.step(native_action(self.action, action))
        observation, reward, terminated, truncated, _ = _entries(given, "the environment's step", STEP)
        self._last, self._over = flat(self._name, observation), bool(terminated or truncated)
        return Taken(self._last, _reward(reward), bool(terminated), bool(truncated))

    def close(self) -> None:
        self._env.close()


class GymnasiumSimulator(_Gymnasium, OfParts):
    """A Gymnasium environment that can be set to a state. It has no wrappers, so no time limit of its own."""

    def __init__(
        self,
        name: str,
        env: Any,
        parts: list[StatePart],
        model: Any = None,
        data: Any = None,
        *,
        limit: int | None = None,
    ) -> None:
        OfParts.__init__(self, parts, model, data)
        _Gymnasium.__init__(self, name, env, limit)
        self.shows = hasattr(env, "_get_obs") and not _needs_arguments(env._get_obs)
        if model is not None and hasattr(env, "init_qpos"):
            start = [np.ravel(env.init_qpos), np.ravel(env.init_qvel)]
            self.rest[: sum(map(len, start))] = np.concatenate(start)
        self.reset(0)

    def write(self, state: Array) -> None:
        # Gymnasium allows no step after an episode has ended: CartPole, for example, would then give the reward 0.
        # So the environment is reset first.
        if self._over:
            self.reset(None)
        super().write(state)

    def restore(self, snapshot: bytes) -> None:
        if self._over:
            self.reset(None)
        super().restore(snapshot)

    def observe(self) -> Array:
        return flat(self._name, self._env._get_obs()) if self.shows else self._last


class ResetOnly(_Gymnasium):
    """A Gymnasium environment whose state can't be read. Its observation serves as the state, and it can
    only be reset."""

    settable = False
    shows = False

    def __init__(self, name: str, env: Any, limit: int | None) -> None:
        super().__init__(name, env, limit)
        self._last = self.reset(0)
        self.rest = self._last
        self.variables = tuple(Variable(f"o{i}") for i in range(len(self._last)))

    def read(self) -> Array:
        return self._last

    def write(self, state: Array) -> None:
        raise UnknownEnvironment(
            f"{self._name} can't be set to {state.tolist()}, because its state can't be read: register it "
            "with --access reset"
        )

    def observe(self) -> Array:
        return self._last


def _entries(given: Any, whose: str, expected: tuple[str, ...]) -> tuple[Any, ...]:
    """Return the values that an environment's reset or step returned, if their number is right.

    Args:
        given: what the environment returned.
        whose: the reset or the step, for messages.
        expected: the names of the values that Gymnasium prescribes.

    Raises:
        StepFailed: ``given`` is not a tuple with as many values as ``expected``.
    """
    if isinstance(given, tuple) and len(given) == len(expected):
        return given
    came = f"{len(given)} values" if isinstance(given, tuple) else f"a {type(given).__name__}"
    raise StepFailed(
        f"expected {whose} to return {len(expected)} values ({', '.join(expected)}), got {came}: correct the "
        "environment"
    )


def _limits_of(space: Any) -> Array | None:
    """Return the limits (D, 2) of an observation space; None if it is not a Box."""
    if type(space).__name__ != "Box":
        return None
    limits: Array = np.stack([np.ravel(space.low), np.ravel(space.high)], axis=1).astype(np.float64)
    return limits


def _reward(given: Any) -> float:
    number = np.asarray(given)
    if number.size != 1 or number.dtype.kind not in "fiub":
        raise StepFailed(
            f"expected the environment's reward to be a number, got {given!r:.60}: wrap the environment in a class of "
            "your own"
        )
    return float(number.item())


def _mujoco(env: Any) -> list[StatePart]:
    parts = mujoco_parts(env.model, env.data, lambda seed: env.reset(seed=seed))
    if holds_numbers(env, "goal"):
        parts.insert(1, Attribute(env, "goal", "held"))
    return parts


def _needs_arguments(function: Any) -> bool:
    parameters = inspect.signature(function).parameters.values()
    return any(p.default is p.empty and p.kind is not p.VAR_POSITIONAL for p in parameters)
