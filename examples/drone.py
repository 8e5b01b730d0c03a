"""One's own environment: a drone in a vertical plane, to be brought to the origin and held there.

surrogym register drone:Drone --name drone --budget 60
surrogym sample drone --env drone:Drone --until-done
surrogym train drone --out drone.zip
surrogym evaluate drone.zip --env drone:Drone --first-seed 20000
"""

import math

import numpy as np

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Success, Term, Uniform
from surrogym_shared.spec import Inequality as Is

GRAVITY, ARM, MASS, INERTIA = 9.81, 0.2, 0.5, 0.1  # m/s^2, m, kg, kg m^2
DT, SUBSTEPS = 0.005, 10  # s; one step of the environment is 0.05 s


def within(low: float, high: float) -> Uniform:
    return Uniform(low=low, high=high)


RANGES = {
    "x": within(-2, 2),  # m
    "z": within(-2, 2),
    "tilt": within(-1, 1),  # rad
    "vx": within(-2, 2),  # m/s
    "vz": within(-2, 2),
    "spin": within(-3, 3),  # rad/s
}


def sides(name: str, value: float, relations: str) -> tuple[Is, Is]:
    """The coordinate beside -value and value: ``<>`` is beyond them, ``><`` between."""
    term = Term.linear(**{name: 1})
    return Is(term=term, relation=relations[0], value=-value), Is(term=term, relation=relations[1], value=value)


class Drone:
    """Each of the two actions adds to what one rotor carries, 30 % of it at most."""

    parallel = True  # a simulation: several instances may be open at once

    def spec(self) -> EnvironmentSpec:
        return EnvironmentSpec(
            environment="drone",
            coordinates=tuple(Coordinate(name=name, sampling=range_) for name, range_ in RANGES.items()),
            observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in RANGES),
            action=BoxAction(low=(-1, -1), high=(1, 1)),
            start={name: within(range_.low / 4, range_.high / 4) for name, range_ in RANGES.items()},
            time_limit=100,
            termination=tuple((side,) for name in ("x", "z") for side in sides(name, 2, "<>")),
            success=Success(hold=(*sides("x", 0.3, "><"), *sides("z", 0.3, "><")), hold_steps=20),
        )

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        x, z, tilt, vx, vz, spin = coordinates
        left, right = MASS * GRAVITY / 2 * (1 + 0.3 * np.asarray(action))  # N
        for _ in range(SUBSTEPS):
            spin += DT * (ARM * (right - left) / INERTIA - spin)
            vx += DT * (-math.sin(tilt) * (left + right) / MASS - 0.1 * vx)
            vz += DT * (math.cos(tilt) * (left + right) / MASS - GRAVITY - 0.1 * vz)
            x, z, tilt = (value + DT * rate for value, rate in ((x, vx), (z, vz), (tilt, spin)))
        cost = 0.25 * (coordinates[0] ** 2 + coordinates[1] ** 2) + 0.05 * float(coordinates[2:] @ coordinates[2:])
        after = (x, z, tilt, vx, vz, spin)
        return RealStep(coordinates, action, after, 1 - cost, terminated=max(abs(x), abs(z)) > 2)

    def close(self) -> None:
        pass
