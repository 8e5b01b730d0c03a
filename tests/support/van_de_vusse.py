"""Van de Vusse's reactions A -> B -> C and 2 A -> D in a stirred tank: B rises and then falls with the flow, and first
goes the wrong way. Its parameters are those of Doyle, Ogunnaike and Pearson, Journal of Process Control 5 (1995)."""

from __future__ import annotations

import numpy as np

from support.processes import process_spec
from surrogym_sampler.original import RealStep
from surrogym_shared.spec import EnvironmentSpec

INTERVAL, SUBSTEPS = 0.005, 20  # hours between two samples
K1, K2, K3 = 50.0, 100.0, 10.0  # 1/h, 1/h, l/(mol h)
FEED = 10.0  # mol/l of A in the feed
RANGES = {"a": (0.0, 10.0), "b": (0.0, 2.0)}  # mol/l
START = {"a": (1.0, 8.0), "b": (0.2, 1.2)}
FLOW = (0.0, 100.0)  # volumes of the tank in an hour
TARGET = 1.0  # mol/l of B


def derivative(a: float, b: float, flow: float) -> tuple[float, float]:
    """Balances of A and B, mol/l in an hour."""
    return flow * (FEED - a) - K1 * a - K3 * a * a, K1 * a - K2 * b - flow * b


def advance(state: tuple[float, float], flow: float) -> tuple[float, float]:
    """The state one interval later, by the midpoint rule."""
    (a, b), step = state, INTERVAL / SUBSTEPS
    for _ in range(SUBSTEPS):
        da, db = derivative(a, b, flow)
        da, db = derivative(a + 0.5 * step * da, b + 0.5 * step * db, flow)
        a, b = a + step * da, b + step * db
    return a, b


class VanDeVusse:
    """Paid for B near its target, with a flow near 30."""

    parallel = True

    def spec(self) -> EnvironmentSpec:
        return process_spec("van_de_vusse", "mol/l", RANGES, START, FLOW)

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        a, b = (float(value) for value in coordinates)
        flow = float(action[0])
        pay = -10.0 * (b - TARGET) ** 2 - 1e-5 * (flow - 30.0) ** 2
        return RealStep(coordinates, action, advance((a, b), flow), pay)

    def close(self) -> None:
        pass
