"""How far back one has to look is found from few real steps, and declared lags that reach so far are enough."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from surrogym_sampler.diagnosis.doctor import environment
from surrogym_sampler.diagnosis.taking import take
from surrogym_sampler.original import make
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.rollouts import answering
from surrogym_shared.dirt import Dirt, identify, sensors
from surrogym_shared.dirt.words import declared
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform, with_history

CIRCLE = Uniform(low=-math.pi, high=math.pi)
STEPS = 60
SPEC = EnvironmentSpec(
    coordinates=(Coordinate(name="angle", kind="angle", sampling=CIRCLE),),
    observation=(ObservationEntry(name="sin", term=Term.sin(angle=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"angle": CIRCLE},
    time_limit=50,
    query="rollout",
)


class Joint:
    """A joint under friction, of which the angle alone is read; a push takes effect after a dead time."""

    def __init__(self, dead_steps=2, changes=0, actions=0, shaking=0.0):
        self.dead_steps, self.declared, self.shaking = dead_steps, (changes, actions), shaking
        self.rng = np.random.default_rng(0)

    def spec(self):
        changes, actions = self.declared
        return with_history(SPEC, changes=changes, actions=actions, largest={"angle": 0.5})

    def reset(self, *, seed=None):
        self.angle, self.speed = np.random.default_rng(seed).uniform(-3, 3, 2) * [1, 0.1]
        self.pipe = [0.0] * self.dead_steps
        return self.angle, {}

    def step(self, action):
        self.pipe.append(float(action[0]))
        self.speed = 0.9 * self.speed + 0.1 * self.pipe.pop(0) + self.shaking * self.rng.standard_normal()
        self.angle += self.speed
        return self.angle, 0.0, False, False, {}

    def coordinates(self, observation):
        return [observation]

    def close(self):
        pass


class Declares(Joint):
    def __init__(self):
        super().__init__(changes=1, actions=2)


class Shakes(Joint):
    def __init__(self):
        super().__init__(shaking=1.0)


class Short(Joint):
    def spec(self):
        return SPEC

    def step(self, action):
        observation, reward, *_ = super().step(action)
        return observation, reward, True, False, {}


def look_back(machine) -> Dirt:
    spec = machine.spec()
    return identify(take(machine, spec, STEPS), sensors(spec))


def said(factory) -> tuple[str, str | None]:
    """The finding on the history, and its way out."""
    (finding,) = [f for f in environment(partial(IsolatedEnvironment, factory, 30.0), STEPS) if f.name == "history"]
    return finding.said, finding.way_out


@pytest.mark.parametrize("dead_steps", range(4))
def test_the_needed_history_for_a_hidden_speed_and_a_dead_time_is_found(dead_steps):
    machine = answering(Joint(dead_steps))
    found = look_back(machine)
    assert found.explained is not None
    assert found.plain is not None
    assert (found.explained.changes, found.actions) == (1, dead_steps)
    assert found.explained.error[0] < 0.02 < 0.1 < found.plain.error[0]


def test_an_environment_with_a_complete_state_needs_no_history():
    machine = make("CartPole-v1", access="reset")
    found = look_back(machine)
    assert found.explained is not None
    assert (found.explained.changes, found.actions) == (0, 0)
    assert not found.named
    machine.close()


def test_the_numbers_of_lagged_actions_and_changes_in_a_specification_are_found():
    assert declared(SPEC) == (0, 0)
    assert declared(with_history(SPEC, changes=3, actions=2, largest={"angle": 1.0}, at_start={"angle": 1.0})) == (3, 2)


def test_the_doctor_command_recommends_the_history_to_declare():
    words, way_out = said(Joint)
    assert "depends on 1 earlier change and 2 earlier actions" in words
    assert "this took 60 real steps" in words
    assert way_out is not None
    assert 'declare with_history(spec, changes=1, actions=2, largest={"angle": ' in way_out
    assert "with at_start if a reset leaves it moving" in way_out


@pytest.mark.parametrize(
    ("factory", "words", "way_out"),
    [
        (Declares, "what is declared tells what happens next", None),
        (Shakes, "a regression does not show how far one has to look back", None),
        (Short, "episodes this short don't tell", "give --history more steps"),
    ],
)
def test_the_doctor_command_tells_why_no_history_needs_to_be_declared(factory, words, way_out):
    found = said(factory)
    assert words in found[0]
    assert found[1] == way_out
