"""A vessel that is filled through a long pipe: an integrator behind a first-order lag and a dead time of three steps.

surrogym register dead_time:Vessel --name vessel --budget 60
surrogym sample vessel --env dead_time:Vessel --until-done
surrogym train vessel --out vessel.zip
surrogym evaluate vessel.zip --env dead_time:Vessel

Only the level is measured, and the vessel can only be reset. `with_history` adds the last change of the level, which
tells of the flow, and the last four actions. `python past.py dead_time` compares a policy with a Smith predictor.
"""

import math
import random

from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform, with_history

DEAD_STEPS, GAIN, TIME_CONSTANT = 3, 0.2, 3.0  # of a step of 1 s
KEPT = math.exp(-1 / TIME_CONSTANT)  # share of the flow that is left after a step
RUN_ON = GAIN * TIME_CONSTANT * (1 - KEPT)  # how far a flow of 1 moves the level within a step


class Vessel:
    """The level is to stay at 0. An action moves the flow, which moves the level."""

    parallel = True

    def __init__(self, changes=1, actions=DEAD_STEPS + 1):
        self.changes, self.actions = changes, actions

    def spec(self):
        plain = EnvironmentSpec(
            environment="vessel",
            coordinates=(Coordinate(name="level", sampling=Uniform(low=-2, high=2)),),
            observation=(ObservationEntry(name="level", term=Term.linear(level=1)),),
            action=BoxAction(low=(-1,), high=(1,)),
            start={"level": Uniform(low=-1.5, high=1.5)},
            time_limit=50,
            query="rollout",
        )
        return with_history(plain, changes=self.changes, actions=self.actions, largest={"level": GAIN})

    def reset(self, *, seed=None):
        self.level, self.flow = random.Random(seed).uniform(-1.5, 1.5), 0.0
        self.pipe = [0.0] * DEAD_STEPS
        return self.level, {}

    def step(self, action):
        reward = -(self.level**2) - 0.1 * float(action[0]) ** 2
        self.pipe.append(float(action[0]))
        self.level, self.flow = moved(self.level, self.flow, self.pipe.pop(0))
        return self.level, reward, False, False, {}

    def coordinates(self, observation):
        return [observation]

    def close(self):
        pass


def moved(level, flow, valve):
    """Level and flow a step later, exact for a valve that is held."""
    return level + RUN_ON * flow + (GAIN - RUN_ON) * valve, KEPT * flow + (1 - KEPT) * valve


class SmithPredictor:
    """Proportional and derivative control of the level as it would be without the dead time, by an exact model."""

    def __init__(self, proportional, derivative):
        self.proportional, self.derivative = proportional, derivative

    def begin(self):
        self.now, self.delayed, self.pipe = (0.0, 0.0), (0.0, 0.0), [0.0] * DEAD_STEPS

    def act(self, level):
        early = level + self.now[0] - self.delayed[0]
        valve = min(max(-self.proportional * early - self.derivative * self.now[1], -1.0), 1.0)
        self.pipe.append(valve)
        self.now, self.delayed = moved(*self.now, valve), moved(*self.delayed, self.pipe.pop(0))
        return valve
