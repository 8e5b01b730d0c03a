"""Which render modes of a surrogate work here. The drawing itself is in ``pictures``, which only a render mode loads.

Shapes: D observation entries, C coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import gymnasium
import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec, Part

Array = NDArray[np.float64]
Read = Callable[[Array], float]  # computes a coordinate from an observation (D,)
RENDER_MODES = ["rgb_array"]
# Module that draws an environment of Gymnasium, and the extra that installs it, by the package of the environment's
# class; None: NumPy is enough.
DRAWN_WITH: dict[str, tuple[str, str] | None] = {
    "gymnasium.envs.classic_control.": ("pygame", "render"),
    "gymnasium.envs.mujoco.": ("mujoco", "mujoco"),
    "surrogym_sampler.original.swingup:": None,
}


def render_modes_of(spec: EnvironmentSpec, original: str | None) -> list[str]:
    """Return the render modes of a surrogate that work here."""
    shown = all(read_of(spec, name) is not None for name in spec.coordinate_names) and can_be_drawn(spec, original)
    return list(RENDER_MODES) if shown else []


def can_be_drawn(spec: EnvironmentSpec, original: str | None = None) -> bool:
    """Whether this process can probably draw an environment: it has its own ``package.module:factory``, or Gymnasium
    draws it and the package for this is installed. No renderer is imported."""
    if original is not None and ":" in original:
        return True
    name = original or spec.environment
    return is_drawn_by_gymnasium(name) and all(find_spec(module) is not None for module, _ in drawn_with(name))


def is_drawn_by_gymnasium(name: str) -> bool:
    """Whether a name from a server is safe to open for drawing: an id of Gymnasium's own packages, or of Surrogym."""
    entry = gymnasium.registry.get(name)
    return entry is not None and str(entry.entry_point).startswith(tuple(DRAWN_WITH))


def drawn_with(name: str) -> list[tuple[str, str]]:
    """Return the module that draws an environment with a Gymnasium id, and the extra that installs it. Empty if NumPy
    is enough."""
    place = str(gymnasium.spec(name).entry_point)
    return [needs for package, needs in DRAWN_WITH.items() if needs is not None and place.startswith(package)]


def read_of(spec: EnvironmentSpec, name: str) -> Read | None:
    """Return a function that computes a coordinate from an observation; None if no entry shows the coordinate."""
    # The observation entries that show the coordinate: by an entry's function, such as "sin", its index, factor and
    # offset.
    found: dict[str, tuple[int, float, float]] = {}
    for index, entry in enumerate(spec.observation):
        parts = [part for part in entry.term.parts if part.function != "one"]
        if len(parts) != 1 or not _of_alone(parts[0], name):
            continue
        part, offset = parts[0], sum(p.coefficient for p in entry.term.parts if p.function == "one")
        weight = part.weights[name]
        if part.function == "linear":
            found["linear"] = (index, part.coefficient * weight, offset)
        elif abs(weight) == 1:
            found[part.function] = (index, part.coefficient * (weight if part.function == "sin" else 1.0), offset)
    if "linear" in found:
        return lambda o: _value(o, found["linear"])
    if {"sin", "cos"} <= found.keys():
        return lambda o: float(np.arctan2(_value(o, found["sin"]), _value(o, found["cos"])))
    return None


def _of_alone(part: Part, name: str) -> bool:
    weights = {key for key, weight in part.weights.items() if weight != 0}
    return weights == {name} and part.coefficient != 0


def _value(observation: Array, place: tuple[int, float, float]) -> float:
    index, factor, offset = place
    return float((observation[index] - offset) / factor)
