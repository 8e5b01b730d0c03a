"""An inverted pendulum with a motor in its joint, as an FMU of FMI 2.0.

pythonfmu build -f inverted_pendulum.py -d . --handle-state --serialize-state
"""

from math import sin
from xml.etree.ElementTree import Element, SubElement

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Initial, Fmi2Slave, Real

GRAVITY, LENGTH, MASS, FRICTION = 9.81, 1.0, 1.0, 0.1
SUBSTEPS = 10


UNITS = ("N.m", "rad", "rad/s")


class WithUnit(Real):
    """A variable with a unit and limits, which pythonfmu does not write."""

    def __init__(self, name: str, attributes: dict[str, str], **others: object) -> None:
        super().__init__(name, **others)
        self.attributes = attributes

    def to_xml(self) -> Element:
        element = super().to_xml()
        element.find("Real").attrib.update(self.attributes)
        return element


class InvertedPendulum(Fmi2Slave):
    """Input: a torque of -5 to 5 Nm. Outputs: the angle from upright in rad, and its speed in rad/s."""

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        self.default_experiment = DefaultExperiment(start_time=0.0, stop_time=5.0, step_size=0.05)
        self.torque, self.angle, self.speed = 0.0, 0.2, 0.0
        limits = {"min": "-5", "max": "5", "unit": "N.m"}
        self.register_variable(WithUnit("torque", limits, causality=Fmi2Causality.input))
        output = {"causality": Fmi2Causality.output, "initial": Fmi2Initial.exact}
        self.register_variable(WithUnit("angle", {"unit": "rad"}, **output))
        self.register_variable(WithUnit("speed", {"unit": "rad/s"}, **output))

    def to_xml(self, *options: object) -> Element:
        root = super().to_xml(*options)
        definitions = Element("UnitDefinitions")
        for unit in UNITS:
            SubElement(definitions, "Unit", name=unit)
        root.insert(1, definitions)
        return root

    def do_step(self, current_time: float, step_size: float) -> bool:
        seconds = step_size / SUBSTEPS
        for _ in range(SUBSTEPS):
            pull = GRAVITY / LENGTH * sin(self.angle) - FRICTION * self.speed
            self.speed += seconds * (pull + self.torque / (MASS * LENGTH**2))
            self.angle += seconds * self.speed
        return True
