"""The shape of a real robot: it can be brought home and acted on, at its own pace, and set to no state.

surrogym register robot:Joint --name joint --budget 60
surrogym sample joint --env robot:Joint --until-done --step-limit 5
surrogym train joint --out joint.zip --steps 200000
surrogym evaluate joint.zip --env robot:Joint --episodes 10

``Motor`` stands for a driver: what talks to your machine goes in its place. ROBOT_PERIOD is its control period, in s.
"""

import math
import os
import random
import time

from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, Fixed, ObservationEntry, Term, Uniform

PERIOD = float(os.environ.get("ROBOT_PERIOD", "0.05"))  # s, by the clock on the wall
TARGET = 0.8  # rad, where the link is to be held against gravity
HOME = 0.1  # rad, how far from hanging it may be when it is home


class Motor:
    """A motor with encoder and a link of 0.5 kg, which this one computes; encoder and tachometer are a little noisy."""

    def __init__(self):
        self.angle, self.speed, self.torque = 0.0, 0.0, 0.0
        self.dice = random.Random()

    def home(self):
        self.angle, self.speed, self.torque = self.dice.uniform(-HOME, HOME), 0.0, 0.0

    def hold(self, torque):  # for one period
        time.sleep(PERIOD)
        for _ in range(10):
            self.speed += 0.005 * (12 * torque - 9 * math.sin(self.angle) - 1.5 * self.speed)
            self.angle += 0.005 * self.speed

    def read(self):
        return self.angle + self.dice.gauss(0, 1e-4), self.speed + self.dice.gauss(0, 1e-3)


class Joint:
    """One joint; the angle counts from hanging."""

    def __init__(self):
        self.motor = Motor()

    def spec(self):
        return EnvironmentSpec(
            environment="joint",
            coordinates=(
                Coordinate(name="angle", unit="rad", sampling=Uniform(low=-1.5, high=1.5)),
                Coordinate(name="speed", unit="rad/s", sampling=Uniform(low=-6, high=6)),
            ),
            observation=(
                ObservationEntry(name="error", term=Term.linear(angle=1) + Term.constant(-TARGET)),
                ObservationEntry(name="speed", term=Term.linear(speed=1)),
            ),
            action=BoxAction(low=(-1,), high=(1,)),
            start={"angle": Uniform(low=-HOME, high=HOME), "speed": Fixed(value=0)},
            time_limit=60,
            query="rollout",
            max_rollout=10,
        )

    def reset(self, *, seed=None):
        self.motor.home()  # a machine can't be seeded
        return self.observe(), {}

    def step(self, action):
        error, speed = self.observe()
        torque = float(action[0])
        reward = -(error**2) - 0.01 * speed**2 - 0.01 * torque**2
        self.motor.hold(torque)
        return self.observe(), reward, False, False, {}

    def observe(self):
        angle, speed = self.motor.read()
        return angle - TARGET, speed

    def coordinates(self, observation):
        error, speed = observation
        return error + TARGET, speed

    def close(self):
        self.motor.torque = 0.0
