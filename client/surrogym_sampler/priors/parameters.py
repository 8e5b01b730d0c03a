"""Named physical parameters of a simulator: their values, and the ranges in which a calibration may change them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

from surrogym_sampler.original.errors import UnknownEnvironment

# the default range of a parameter goes from its own value divided by this factor to its own value times this factor
AROUND = 2.0


@runtime_checkable
class Adjustable(Protocol):
    """A simulator whose parameters can be read and changed. A change takes effect from the next step on.

    Examples:
        A class that computes something from its parameters defines the two methods itself::

            class Cart:
                def parameters(self):
                    return {"mass": self.mass}

                def set_parameters(self, values):
                    self.mass = values["mass"]
                    self.inverse = 1 / self.mass
    """

    def parameters(self) -> Mapping[str, float]:
        """Return all parameters that can be changed, with their current values."""
        ...

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Change the given parameters; the others keep their values."""
        ...


class Attributes:
    """Offers the numeric attributes of an object that lacks ``parameters`` and ``set_parameters`` as its parameters."""

    def __init__(self, plant: object) -> None:
        self._plant = plant

    def parameters(self) -> dict[str, float]:
        """Return the attributes that are numbers, including those of the class."""
        names = [name for name in dir(self._plant) if not name.startswith("_")]
        return {name: float(value) for name in names if _is_number(value := getattr(self._plant, name))}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Set attributes of the object; those of its class stay as they are."""
        for name, value in values.items():
            setattr(self._plant, name, value)


@dataclass(frozen=True)
class Parameter:
    """A parameter to be calibrated, and the range of its values."""

    name: str
    low: float
    high: float

    @classmethod
    def parse(cls, text: str, present: Mapping[str, float]) -> Self:
        """Read ``NAME`` or ``NAME=LOW..HIGH``. The default range is half to twice the simulator's own value.

        Args:
            text: the parameter.
            present: the simulator's own values, by name.

        Raises:
            ValueError: the simulator has no such parameter, or the range is invalid or does not contain the simulator's
                own value.
        """
        name, equals, span = text.partition("=")
        if name not in present:
            known = ", ".join(sorted(present)) or "none"
            raise ValueError(f"expected the name of a parameter of the simulator ({known}), got {name!r}")
        value = present[name]
        if not equals:
            if value == 0:
                raise ValueError(
                    f"{name}: expected a range, because the simulator's own value is 0, got none: give {name}=LOW..HIGH"
                )
            return cls(name, *sorted((value / AROUND, value * AROUND)))
        try:
            low, high = (float(end) for end in span.split(".."))
        except ValueError as error:
            raise ValueError(f"expected NAME=LOW..HIGH, such as mass=0.5..2, got {text!r}") from error
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"range of {name}: expected two finite numbers, the smaller one first, got {span}")
        if not low <= value <= high:
            raise ValueError(
                f"range of {name}: expected one that contains the simulator's own value {value:g}, got {span}: widen it"
            )
        return cls(name, low, high)


def adjustable(simulator: Any) -> Adjustable:
    """Return the parameters of an original environment.

    These are what its methods ``parameters`` and ``set_parameters`` offer, or else its attributes that are numbers.

    Raises:
        UnknownEnvironment: the environment runs in another process, so that its parameters can't be reached.
    """
    for plant in _layers(simulator):
        if isinstance(plant, Adjustable):
            return plant
    if getattr(simulator, "step_from", None) is None:
        raise UnknownEnvironment(
            "expected a simulator in this process, got a simulator in another process, whose parameters can't be "
            "changed from here: write a class that runs the simulator in this process (docs/how-to/priors.md)"
        )
    return Attributes(_layers(simulator)[-1])


def read_parameters(texts: Sequence[str], plant: Adjustable) -> tuple[Parameter, ...]:
    """Read the parameters to be calibrated, each from a text ``NAME`` or ``NAME=LOW..HIGH``. Raises ``ValueError`` if a
    text is invalid or a parameter is given twice."""
    present = plant.parameters()
    read = tuple(Parameter.parse(text, present) for text in texts)
    names = [parameter.name for parameter in read]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(
            f"expected each parameter once, got {', '.join(sorted(twice))} several times: remove the repetitions"
        )
    return read


def _layers(simulator: Any) -> list[Any]:
    """Return the environment and the environments inside it that it wraps, from the outermost to the innermost."""
    layers = [simulator]
    while (inner := getattr(layers[-1], "wrapped", None) or getattr(layers[-1], "simulator", None)) is not None:
        layers.append(inner)
    return layers


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
