"""Pictures of virtual states: an observation is converted to coordinates, and the original environment's renderer draws
them.

The renderer belongs to the sampler's package, and is imported only when an environment is made with a render mode.

Shapes: D observation entries, C coordinates; a picture is (height, width, 3) uint8.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec, Part

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Read = Callable[[Array], float]  # computes a coordinate from an observation (D,)
RENDER_MODES = ["rgb_array"]
RENDERERS = "surrogym_sampler.original.rendering"  # module with the function renderer_of
# Module that draws an environment of Gymnasium, and the extra that installs it, by the package of the environment's
# class; None: NumPy is enough.
DRAWN_WITH: dict[str, tuple[str, str] | None] = {
    "gymnasium.envs.classic_control.": ("pygame", "render"),
    "gymnasium.envs.mujoco.": ("mujoco", "mujoco"),
    "surrogym_sampler.original.swingup:": None,
}


class NotRenderable(Exception):
    """The environment has no renderer, the renderer can't run here, or the observation does not determine the state."""


class Renderer(Protocol):
    """Draws states of one environment."""

    frames_per_second: int

    def draw(self, coordinates: Array) -> Picture:
        """Draw the state at coordinates (C,)."""
        ...

    def close(self) -> None:
        """Release windows and memory of the renderer."""
        ...


class Pictures:
    """Draws observations of one surrogate with the original environment's renderer.

    Args:
        spec: specification of the original environment.
        original: ``package.module:factory`` of your own environment. Environments with a built-in adapter don't need
            it.

    Raises:
        NotRenderable: the environment has no renderer, or the state can't be computed from observations.
    """

    def __init__(self, spec: EnvironmentSpec, original: str | None = None) -> None:
        self._read = coordinates_from_observation(spec)
        self._renderer: Renderer = import_module(RENDERERS).renderer_of(spec, original)
        self.frames_per_second = self._renderer.frames_per_second

    def of(self, observation: NDArray[Any] | None) -> Picture:
        """Draw an observation (D,) as an array (height, width, 3).

        Raises:
            ResetNeeded: there is no observation yet.
        """
        if observation is None:
            raise gymnasium.error.ResetNeeded("expected reset() before render(), got render() first")
        return self._renderer.draw(self._read(np.asarray(observation, dtype=np.float64)))

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def pictures_for(render_mode: str | None, spec: EnvironmentSpec, original: str | None) -> Pictures | None:
    """Return an object that draws observations in the given render mode; None without a render mode.

    Raises:
        ValueError: an unknown render mode.
        NotRenderable: there is no renderer, or the state can't be computed from observations.
    """
    if render_mode is None:
        return None
    if render_mode not in RENDER_MODES:
        raise ValueError(f"expected render_mode None or rgb_array for a surrogate, got {render_mode!r}")
    return Pictures(spec, original)


def metadata_of(spec: EnvironmentSpec, original: str | None, pictures: Pictures | None) -> dict[str, Any]:
    """Return Gymnasium's ``metadata`` of a surrogate: the render modes that work here, and the pictures' frames per
    second."""
    fps = {} if pictures is None else {"render_fps": pictures.frames_per_second}
    return {"render_modes": _render_modes(spec, original), **fps}


def _render_modes(spec: EnvironmentSpec, original: str | None) -> list[str]:
    shown = all(_read(spec, name) is not None for name in spec.coordinate_names) and can_be_drawn(spec, original)
    return list(RENDER_MODES) if shown else []


def can_be_drawn(spec: EnvironmentSpec, original: str | None = None) -> bool:
    """Whether this process can probably draw an environment: it has its own ``package.module:factory``, or Gymnasium
    draws it and the package for this is installed. No renderer is imported."""
    if original is not None and ":" in original:
        return True
    name = original or spec.environment
    return is_drawn_by_gymnasium(name) and all(find_spec(module) is not None for module, _ in drawn_with(name))


def is_drawn_by_gymnasium(name: str) -> bool:
    """Whether a name from a server is safe to open for drawing: an id of Gymnasium's own packages, or of this one."""
    entry = gymnasium.registry.get(name)
    return entry is not None and str(entry.entry_point).startswith(tuple(DRAWN_WITH))


def drawn_with(name: str) -> list[tuple[str, str]]:
    """Return the module that draws an environment with a Gymnasium id, and the extra that installs it. Empty if NumPy
    is enough."""
    place = str(gymnasium.spec(name).entry_point)
    return [needs for package, needs in DRAWN_WITH.items() if needs is not None and place.startswith(package)]


def coordinates_from_observation(spec: EnvironmentSpec) -> Callable[[Array], Array]:
    """Return a function that computes coordinates (C,) from an observation (D,).

    It uses entries that are linear in one coordinate, and pairs of entries with the sine and cosine of an angle.

    Raises:
        NotRenderable: a coordinate can't be computed from the observation.
    """
    reads = [_read(spec, name) for name in spec.coordinate_names]
    if missing := [name for name, read in zip(spec.coordinate_names, reads, strict=True) if read is None]:
        raise NotRenderable(
            f"expected observations from which every coordinate can be computed, got none for {missing[0]!r}"
        )
    known = [read for read in reads if read is not None]
    return lambda observation: np.array([read(observation) for read in known])


def _read(spec: EnvironmentSpec, name: str) -> Read | None:
    found: dict[str, tuple[int, float, float]] = {}  # index of the entry, factor and offset, by the entry's function
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
