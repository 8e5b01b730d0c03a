"""A continuous fermenter whose substrate inhibits growth (Haldane kinetics): a process of another chemistry than the
reactor's. Its parameters are those of Agrawal, Lee, Lim and Ramkrishna, Chemical Engineering Science 37 (1982)."""

from __future__ import annotations

import numpy as np

from support.processes import process_spec
from surrogym_sampler.original import RealStep
from surrogym_shared.spec import EnvironmentSpec

INTERVAL, SUBSTEPS = 0.5, 20  # hours between two samples
FEED, YIELD = 4.0, 0.4  # g/l of substrate in the feed; g of biomass from a gram of substrate
RANGES = {"biomass": (0.0, 1.8), "substrate": (0.0, 4.0)}  # g/l
START = {"biomass": (0.2, 1.2), "substrate": (0.5, 3.5)}
DILUTION = (0.0, 0.6)  # 1/h


def growth(substrate: float) -> float:
    """Specific rate of growth, 1/h."""
    return 0.53 * substrate / (0.12 + substrate + 0.4545 * substrate**2)


def advance(state: tuple[float, float], dilution: float) -> tuple[float, float]:
    """The state one interval later, by the midpoint rule."""
    now, step = np.array(state), INTERVAL / SUBSTEPS

    def derivative(at: np.ndarray) -> np.ndarray:
        x, s = at.tolist()
        made = growth(s) * x
        return np.array([made - dilution * x, dilution * (FEED - s) - made / YIELD])

    for _ in range(SUBSTEPS):
        now = np.maximum(now + step * derivative(now + 0.5 * step * derivative(now)), 0.0)
    return float(now[0]), float(now[1])


class Fermenter:
    """Paid for the biomass that leaves it, g/l in an hour."""

    parallel = True

    def spec(self) -> EnvironmentSpec:
        return process_spec("fermenter", "g/l", RANGES, START, DILUTION)

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        dilution = float(action[0])
        return RealStep(coordinates, action, advance(tuple(coordinates), dilution), dilution * float(coordinates[0]))

    def close(self) -> None:
        pass
