"""Two tanks one above the other, as an FMU of FMI 2.0.

A pump fills the upper tank, which drains into the lower one. Build it into this folder:

pip install ".[fmu]" pythonfmu
pythonfmu build -f two_tanks.py -d . --handle-state --serialize-state
"""

from math import sqrt
from xml.etree.ElementTree import Element

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real

AREA = 0.0154  # m^2
HOLE = 5e-5  # m^2
GRAVITY = 9.81  # m/s^2
HEIGHT = 1.0  # m, where a tank overflows
SUBSTEPS = 20


def drained(level: float) -> float:
    """Speed of the level of a tank that drains, in m/s."""
    return HOLE / AREA * sqrt(2 * GRAVITY * max(level, 0.0))


class Limited(Real):
    """A variable with limits, which pythonfmu does not write."""

    def __init__(self, name: str, low: float, high: float, **others: object) -> None:
        super().__init__(name, **others)
        self.limits = {"min": f"{low:g}", "max": f"{high:g}"}

    def to_xml(self) -> Element:
        element = super().to_xml()
        element.find("Real").attrib.update(self.limits)
        return element


class TwoTanks(Fmi2Slave):
    """Input: the pump, 0 to 1. Outputs: both levels in m. Parameter: the flow of the pump in m^3/s."""

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        self.default_experiment = DefaultExperiment(start_time=0.0, stop_time=1000.0, step_size=10.0)
        self.pump, self.upper, self.lower, self.flow = 0.0, 0.1, 0.1, 2.8e-4
        self.register_variable(Limited("pump", 0.0, 1.0, causality=Fmi2Causality.input))
        for level in ("upper", "lower"):
            self.register_variable(
                Limited(level, 0.0, HEIGHT, causality=Fmi2Causality.output, initial=Fmi2Initial.exact)
            )
        self.register_variable(Real("flow", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))

    def do_step(self, current_time: float, step_size: float) -> bool:
        seconds = step_size / SUBSTEPS
        for _ in range(SUBSTEPS):
            falling = drained(self.upper)
            upper = self.upper + seconds * (self.flow / AREA * self.pump - falling)
            lower = self.lower + seconds * (falling - drained(self.lower))
            self.upper, self.lower = min(max(upper, 0.0), HEIGHT), min(max(lower, 0.0), HEIGHT)
        return True
