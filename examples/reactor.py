"""A stirred-tank reactor with nonlinear kinetics, and a log of its operation.

python reactor.py reactor.csv
surrogym import reactor.csv --register reactor --wait 120
surrogym train reactor --out reactor.zip
surrogym evaluate reactor.zip --env reactor:Reactor

The log is what a plant would have: 50 runs of 100 samples, in which an operator holds the temperature and tries things.
Nobody sets the plant to a state for it, and the model is learned from the log alone.
"""

import sys

import numpy as np

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import Bounds, BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

INTERVAL = 0.05  # minutes between two samples
SUBSTEPS = 20
COOLANT = (280.0, 320.0)  # K
RELIEF = 400.0  # K; the relief valve lets it get no hotter
TARGET = 0.5  # mol/l, between the cold and the hot steady state, where the reactor does not stay by itself
HEADING = ("run", "time", "concentration", "temperature", "action_coolant", "reward")
FOLLOWING = ("next_concentration", "next_temperature")


def derivative(concentration, temperature, coolant):
    """Balance of mass and heat, per minute; the rate follows Arrhenius."""
    rate = 7.2e10 * np.exp(-8750.0 / temperature) * concentration
    return 1.0 - concentration - rate, 350.0 - temperature + 209.2 * rate + 2.092 * (coolant - temperature)


def advance(state, coolant):
    """The state one interval later."""
    c, t = state
    step = INTERVAL / SUBSTEPS
    for _ in range(SUBSTEPS):
        dc, dt = derivative(c, t, coolant)
        middle = derivative(c + 0.5 * step * dc, t + 0.5 * step * dt, coolant)
        c, t = c + step * middle[0], min(t + step * middle[1], RELIEF)
    return float(c), float(t)


def pay(state, coolant):
    """Close to the target, with little work of the coolant."""
    return -10.0 * (state[0] - TARGET) ** 2 - 1e-4 * (coolant - 300.0) ** 2


class Reactor:
    """The reactor as an original environment, to judge a policy in."""

    parallel = True  # a simulation: several instances may be open at once

    def spec(self):
        concentration = Coordinate(name="concentration", unit="mol/l", sampling=Uniform(low=0, high=1))
        temperature = Coordinate(
            name="temperature", unit="K", sampling=Uniform(low=300, high=RELIEF), bounds=Bounds(high=RELIEF)
        )
        names = ("concentration", "temperature")
        return EnvironmentSpec(
            environment="reactor",
            coordinates=(concentration, temperature),
            observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in names),
            action=BoxAction(low=(COOLANT[0],), high=(COOLANT[1],)),
            start={"concentration": Uniform(low=0.3, high=0.9), "temperature": Uniform(low=320, high=370)},
            time_limit=100,
        )

    def step_from(self, coordinates, action):
        after = advance(tuple(coordinates), float(action[0]))
        return RealStep(coordinates, action, after, pay(coordinates, float(action[0])))

    def close(self):
        pass


def operate(runs=50, length=100, seed=0):
    """Rows of a log: an operator holds changing set points of the temperature, and the coolant jitters."""
    rng = np.random.default_rng(seed)
    for run in range(runs):
        state = (float(rng.uniform(0.3, 0.9)), float(rng.uniform(320, 370)))
        for sample in range(length):
            if sample % 20 == 0:
                held, gain = rng.uniform(325, 375), rng.uniform(0.0, 3.0)
            coolant = float(np.clip(300 + gain * (held - state[1]) + rng.normal(0, 5), *COOLANT))
            after = advance(state, coolant)
            yield run, round(INTERVAL * sample, 6), *state, coolant, pay(state, coolant), *after
            state = after


def write(path, rows):
    """A log as CSV, NPZ or Parquet, by the ending of its name."""
    columns = dict(zip((*HEADING, *FOLLOWING), map(np.array, zip(*rows, strict=True)), strict=True))
    if path.endswith(".npz"):
        np.savez(path, **columns)
    elif path.endswith(".parquet"):
        import pyarrow
        from pyarrow import parquet

        parquet.write_table(pyarrow.table(columns), path)
    else:
        with open(path, "w", encoding="utf-8") as file:
            print(*columns, sep=",", file=file)
            for row in zip(*columns.values(), strict=True):
                print(*(cell.item() for cell in row), sep=",", file=file)


if __name__ == "__main__":
    write(sys.argv[1], list(operate()))
