"""A point on a plane, paid for one narrow place: a bump of width 0.1 in a range of 3 on either side.

surrogym register bump:Bump --name bump --budget 100
surrogym sample bump --env bump:Bump
surrogym train bump --wait 600 --out bump.zip
surrogym evaluate bump.zip --env bump:Bump

The reward is next to nothing nearly everywhere. The model learns its logarithm, which is a parabola, and knows it after
some ten real steps.
"""

import numpy as np

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import Bounds, BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

RANGES = {"x": Uniform(low=-3, high=3), "y": Uniform(low=-3, high=3)}
STEP, PLACE, WIDTH = 0.2, np.array([1.0, -0.5]), 0.1


class Bump:
    """Both actions move the point by 0.2 at most."""

    parallel = True

    def spec(self):
        return EnvironmentSpec(
            environment="bump",
            coordinates=tuple(Coordinate(name=n, sampling=r, bounds=Bounds(low=-3, high=3)) for n, r in RANGES.items()),
            observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in RANGES),
            action=BoxAction(low=(-1, -1), high=(1, 1)),
            start=RANGES,
            time_limit=100,
        )

    def step_from(self, coordinates, action):
        q = np.asarray(coordinates, dtype=float)
        after = np.clip(q + STEP * np.asarray(action), -3, 3)
        return RealStep(q, action, after, float(np.exp(-0.5 * np.sum((q - PLACE) ** 2) / WIDTH**2)))

    def close(self):
        pass
