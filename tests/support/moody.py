"""Environments with moods, for tests; a module of their own because they are made in child processes."""

from __future__ import annotations

import time

import numpy as np

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    Design,
    EnvironmentSpec,
    Fixed,
    ObservationEntry,
    Quantity,
    RewardTerm,
    Term,
    Uniform,
)

SPEC = EnvironmentSpec(
    environment="a line",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=-0.5, high=0.5)},
    time_limit=20,
    design=Design(initial=6, budget=6),
)


ERROR = RewardTerm(weight=-1.0, shape="absolute", of=(Quantity(term=Term.linear(x=1)),))
DECLARED = SPEC.model_copy(update={"reward": DeclaredReward(kind="declared", terms=(ERROR,))})


class Line:
    """x' = x + u / 10; the reward is -|x|."""

    def spec(self):
        return SPEC

    def step_from(self, coordinates, action):
        return RealStep(coordinates, action, coordinates + 0.1 * np.asarray(action), reward=-abs(float(coordinates[0])))

    def close(self):
        pass


class Alike(Line):
    """Begins every episode at the same state."""

    def spec(self):
        return SPEC.model_copy(update={"start": {"x": Fixed(value=0.25)}, "time_limit": 5})


class RaisesLeft(Line):
    """Raises where x is negative."""

    def step_from(self, coordinates, action):
        if coordinates[0] < 0:
            raise RuntimeError("there is a wall on the left")
        return super().step_from(coordinates, action)


class HangsLeft(Line):
    """Never comes back from where x is negative."""

    def step_from(self, coordinates, action):
        if coordinates[0] < 0:
            time.sleep(3600)
        return super().step_from(coordinates, action)


class GivesNonsense(Line):
    """Gives one number too many."""

    def step_from(self, coordinates, action):
        return RealStep(coordinates, action, [1.0, 2.0], reward=0.0)


class Slow(Line):
    """Takes two seconds."""

    def step_from(self, coordinates, action):
        time.sleep(2.0)
        return super().step_from(coordinates, action)


class Unhurried(Line):
    """Takes half a second."""

    def step_from(self, coordinates, action):
        time.sleep(0.5)
        return super().step_from(coordinates, action)
