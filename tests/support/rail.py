"""Environments that can only be reset and acted on; a module of their own because they are made in child processes."""

from __future__ import annotations

import os
import time

import numpy as np

from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    Design,
    EnvironmentSpec,
    Inequality,
    ObservationEntry,
    Term,
    Uniform,
)

SPEC = EnvironmentSpec(
    environment="a rail",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=-0.2, high=0.2)},
    termination=((Inequality(term=Term.linear(x=1), relation=">=", value=1),),),
    time_limit=20,
    query="rollout",
    design=Design(initial=6, budget=10),
)


class Rail:
    """x' = x + u / 10; the reward is -|x|; an episode ends at x = 1. It tells x twice, as a camera with two eyes."""

    def __init__(self):
        self.rng = np.random.default_rng(0)
        self.x = 0.0

    def spec(self):
        return SPEC

    def reset(self, *, seed=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.x = self.rng.uniform(-0.2, 0.2)
        return np.array([self.x, self.x]), {}

    def step(self, action):
        reward = -abs(self.x)
        self.x += 0.1 * float(action[0])
        return np.array([self.x, self.x]), reward, self.x >= 1, False, {}

    def coordinates(self, observation):
        return observation[:1]

    def close(self):
        pass


class Timed(Rail):
    """Declares a sampling period, and waits for it in each step if it is a machine; one of its steps may come late."""

    period = 0.1  # long beside what a busy machine adds to a step

    def __init__(self, machine: bool, late: float = 0.0, at: int = 7):
        super().__init__()
        self.machine, self.late, self.at, self.steps = machine, late, at, 0

    def spec(self):
        return SPEC.model_copy(update={"sampling_period": self.period})

    def reset(self, *, seed=None):
        self.steps = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.steps += 1
        time.sleep(self.period * self.machine + self.late * (self.steps == self.at))
        return super().step(action)


class RaisesRight(Rail):
    """Raises when it is pushed to the right."""

    def step(self, action):
        if action[0] > 0:
            raise RuntimeError("the rail is blocked")
        return super().step(action)


class HangsRight(Rail):
    """Never comes back when it is pushed to the right."""

    def step(self, action):
        if action[0] > 0:
            time.sleep(3600)
        return super().step(action)


class DiesRight(Rail):
    """Ends its process when it is pushed to the right."""

    def step(self, action):
        if action[0] > 0:
            os._exit(7)
        return super().step(action)


class Slow(Rail):
    """Takes a second for a step."""

    def step(self, action):
        time.sleep(1.0)
        return super().step(action)
