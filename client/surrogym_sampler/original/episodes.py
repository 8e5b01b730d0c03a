"""Whole episodes in an original environment, for evaluations.

Shapes: C coordinates, D observation entries, F action entries.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.errors import NotPerturbable, NotSettable, StepFailed, UnknownEnvironment
from surrogym_sampler.original.gymnasium import native_action, opens_task, shows_the_same, task_for, wrapped
from surrogym_sampler.original.protocol import (
    Array,
    Environment,
    Factory,
    OriginalEnvironment,
    RealStep,
    RolloutEnvironment,
    runs_in_parallel,
)
from surrogym_sampler.original.rollouts import answering
from surrogym_sampler.original.simulator import Simulated, random_factor
from surrogym_shared.rates import rates
from surrogym_shared.spec import EnvironmentSpec, Fixed, Normal, Uniform, limits


class GymnasiumEpisode(Episode):
    """An episode of a Gymnasium task with a built-in specification. If the specification declares the same observation
    as the environment, observations come from the environment itself; otherwise they are computed as declared."""

    parallel = True

    def __init__(self, spec: EnvironmentSpec) -> None:
        super().__init__(spec)
        self._task = task_for(spec.environment, "default")
        self._env: Any = gymnasium.make(spec.environment).unwrapped
        # the attributes that ``perturb`` changes, with their original values
        self._physics = {name: getattr(self._env, name) for name in self._task.perturbable}
        self._own_observation = shows_the_same(spec)

    def reset(self, seed: int) -> Moment:
        observation, _ = self._env.reset(seed=seed)
        return self._moment(observation, 0.0, terminated=False)

    def place(self, coordinates: Array) -> Moment:
        self._env.reset(seed=0)
        self._task.write(self._env, coordinates)
        return Moment(self._shown(coordinates), 0.0, False, coordinates)

    def step(self, action: Array) -> Moment:
        observation, reward, terminated, _, _ = self._env.step(native_action(self.spec.action, action))
        return self._moment(observation, float(reward), terminated=bool(terminated))

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        for name, value in self._physics.items():
            setattr(self._env, name, value * random_factor(rng, sigma))
        if self._task.settle is not None:
            self._task.settle(self._env)

    def close(self) -> None:
        self._env.close()

    def _moment(self, observation: Any, reward: float, *, terminated: bool) -> Moment:
        coordinates = wrapped(self.spec, self._task.read(self._env))
        shown = np.asarray(observation) if self._own_observation else self._shown(coordinates)
        return Moment(shown, reward, terminated, coordinates)


class SimulatedEpisode(Episode):
    """An episode of a simulator that an adapter opened. ``perturb`` changes the masses of all bodies.

    If the built-in specification declares the same observation as the environment, observations come from the
    environment itself; otherwise they are computed as declared.
    """

    def __init__(self, environment: Simulated) -> None:
        super().__init__(environment.spec())
        self._environment = environment
        self.parallel = runs_in_parallel(environment)

    def reset(self, seed: int) -> Moment:
        if self._environment.shows_own:
            observation = self._environment.simulator.reset(seed)
            return Moment(observation, 0.0, False, self._environment.coordinates())
        coordinates = self._environment.begin(seed)
        return Moment(self._shown(coordinates), 0.0, False, coordinates)

    def place(self, coordinates: Array) -> Moment:
        if not self._environment.simulator.settable:
            raise NotSettable(
                f"this environment can't be set to the state {coordinates.tolist()}: it can only be reset, so begin "
                "episodes at its own starts, without --wide and --start-scale"
            )
        self._environment.simulator.reset(0)
        self._environment.place(coordinates)
        return Moment(self._shown(coordinates), 0.0, False, coordinates)

    def step(self, action: Array) -> Moment:
        step = self._environment.act(action)
        reached = np.asarray(step.next_coordinates)
        shown = self._shown(reached) if step.next_observation is None else np.asarray(step.next_observation)
        return Moment(shown, step.reward, step.terminated, reached, step.truncated)

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        self._environment.simulator.perturb(rng, sigma)

    def close(self) -> None:
        self._environment.close()


class OwnEpisode(Episode):
    """An episode of an environment that a user wrote."""

    def __init__(self, environment: Environment) -> None:
        super().__init__(environment.spec())
        self.parallel = runs_in_parallel(environment)

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        del rng, sigma
        raise NotPerturbable(
            "expected an environment with a built-in adapter for a perturbation, got one of your own: write a class "
            "with changed physics, and give it with --env"
        )

    def _started(self, coordinates: Array) -> Moment:
        return Moment(self._shown(coordinates), 0.0, False, coordinates)

    def _stepped(self, step: RealStep) -> Moment:
        reached, reward = np.asarray(step.next_coordinates, dtype=np.float64), float(step.reward)
        if reached.shape != (size := len(self.spec.coordinates),) or not np.isfinite([*reached, reward]).all():
            raise StepFailed(
                f"expected a step of the environment to give {size} finite coordinates and a finite reward, got "
                f"{reached.tolist()} and {reward}: correct the environment"
            )
        return Moment(self._shown(reached), reward, bool(step.terminated), reached, bool(step.truncated))


class RolloutEpisode(OwnEpisode):
    """An episode of a user's environment that can only be reset, not set to a state."""

    def __init__(self, environment: RolloutEnvironment) -> None:
        super().__init__(environment)
        self._environment = environment
        self._rated = bool(rates(environment.spec()))  # whether a declared rate may change actions

    def reset(self, seed: int) -> Moment:
        return self._started(self._environment.begin(seed))

    def place(self, coordinates: Array) -> Moment:
        raise NotSettable(
            f"this environment can't be set to the state {coordinates.tolist()}: it can only be reset, so begin "
            "episodes at its own starts, without --wide and --start-scale"
        )

    def resume(self, coordinates: Array) -> None:
        if hasattr(self._environment, "resume"):
            self._environment.resume(coordinates)

    def step(self, action: Array) -> Moment:
        step = self._environment.act(action)
        moment = self._stepped(step)
        return replace(moment, applied=np.asarray(step.action)) if self._rated else moment

    def close(self) -> None:
        self._environment.close()


class SteppedEpisode(OwnEpisode):
    """An episode of a user's environment that can be set to a state: each step begins where the previous one ended."""

    def __init__(self, environment: OriginalEnvironment) -> None:
        super().__init__(environment)
        self._environment = environment
        self._at = np.zeros(0)

    def reset(self, seed: int) -> Moment:
        return self.place(draw(self.spec, np.random.default_rng(seed), wide=False))

    def place(self, coordinates: Array) -> Moment:
        self._at = coordinates
        return self._started(coordinates)

    def step(self, action: Array) -> Moment:
        moment = self._stepped(self._environment.step_from(self._at, action))
        self._at = moment.coordinates
        return moment

    def close(self) -> None:
        self._environment.close()


def open_episode(name: str, spec: EnvironmentSpec | None, factory: Factory, fallback: str | None = None) -> Episode:
    """Open an episode of an environment, in which the limits of its specification are kept.

    Args:
        name: the environment's name.
        spec: a specification that replaces the environment's own; None keeps the own one.
        factory: makes the environment, unless the name is that of a built-in Gymnasium task.
        fallback: program of the fallback that the specification's limits name, as NAME=package.module:function.

    Raises:
        UnknownEnvironment: the limits name a fallback, and ``fallback`` does not give its program; or the reverse.
    """
    episode = _open(name, spec, factory)
    if episode.spec.limits is None and fallback is None:
        return episode
    from surrogym_sampler.original.limits import GuardedEpisode

    try:
        return GuardedEpisode(episode, fallback)
    except UnknownEnvironment:
        episode.close()
        raise


def _open(name: str, spec: EnvironmentSpec | None, factory: Factory) -> Episode:
    if opens_task(name, spec):
        return GymnasiumEpisode(spec or factory().spec())
    made = factory()
    if isinstance(made, Simulated):
        return SimulatedEpisode(made)
    environment = answering(made)
    if isinstance(environment, OriginalEnvironment):
        return SteppedEpisode(environment)
    return RolloutEpisode(environment)


def draw(spec: EnvironmentSpec, rng: np.random.Generator, *, wide: bool, scale: float = 1.0) -> Array:
    """Draw start coordinates (C,), from the start distribution or from the whole sampling range.

    Args:
        spec: the environment's specification.
        rng: random generator.
        wide: whether to draw from the sampling range.
        scale: factor by which starts are moved away from the middle of the start distribution; bounds are kept.
    """
    if spec.starts and not wide and scale == 1:
        return np.array(spec.starts[rng.integers(len(spec.starts))])
    chosen = [c.sampling if wide else spec.start[c.name] for c in spec.coordinates]
    drawn = np.array([_draw_one(distribution, rng) for distribution in chosen])
    if scale == 1:
        return drawn
    middle = np.array([sum(limits(distribution)) / 2 for distribution in chosen])
    return wrapped(spec, middle + scale * (drawn - middle))


def _draw_one(distribution: Uniform | Normal | Fixed, rng: np.random.Generator) -> float:
    match distribution:
        case Fixed():
            return distribution.value
        case Uniform():
            return float(rng.uniform(distribution.low, distribution.high))
        case Normal():
            low, high = distribution.limits
            while not low <= (value := float(rng.normal(distribution.mean, distribution.std))) <= high:
                pass
            return value
