"""A mass on a spring, pushed by a noisy motor: process noise of 1 % of each range.

surrogym register noisy_mass:NoisyMass --name mass --budget 60
surrogym sample mass --env noisy_mass:NoisyMass
surrogym train mass --wait 600 --out mass.zip
surrogym evaluate mass.zip --env noisy_mass:NoisyMass

The design asks for some steps twice, and so finds that what it can't predict is noise.
"""

import numpy as np

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

RANGES = {"x": Uniform(low=-2, high=2), "speed": Uniform(low=-3, high=3)}
DT = 0.1  # s
TARGET, WIDTH = 1.0, 0.4  # m


class NoisyMass:
    """Each step adds noise of ``noise`` times its range to position and speed."""

    parallel = True

    def __init__(self, spring=1.0, drag=0.5, noise=0.01, seed=None):
        self.spring, self.drag, self.noise = spring, drag, noise
        self.rng = np.random.default_rng(seed)

    def spec(self):
        return EnvironmentSpec(
            environment="noisy mass",
            coordinates=tuple(Coordinate(name=name, sampling=range_) for name, range_ in RANGES.items()),
            observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in RANGES),
            action=BoxAction(low=(-1,), high=(1,)),
            start={"x": Uniform(low=-1, high=1), "speed": Uniform(low=-0.5, high=0.5)},
            time_limit=100,
        )

    def step_from(self, coordinates, action):
        x, speed = coordinates
        push = 3.0 * float(action[0]) - self.spring * x - self.drag * speed
        spread = self.noise * np.array([range_.high - range_.low for range_ in RANGES.values()])
        after = np.array([x + DT * speed, speed + DT * push]) + spread * self.rng.standard_normal(2)
        reward = np.exp(-0.5 * ((x - TARGET) / WIDTH) ** 2) - 0.01 * float(action[0]) ** 2
        return RealStep(coordinates, action, after, float(reward))

    def close(self):
        pass
