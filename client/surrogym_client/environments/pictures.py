"""Pictures of virtual states: an observation is converted to coordinates, and the original environment's renderer draws
them.

The renderer belongs to the sampler's package, and is imported only when an environment is made with a render mode.

Shapes: D observation entries, C coordinates; a picture is (height, width, 3) uint8.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.render_modes import RENDER_MODES, read_of
from surrogym_shared.spec import EnvironmentSpec

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
RENDERERS = "surrogym_sampler.original.rendering"  # module with the function renderer_of


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
            raise gymnasium.error.ResetNeeded(
                "expected a call of reset() before render(), got render() first: call reset()"
            )
        return self._renderer.draw(self._read(np.asarray(observation, dtype=np.float64)))

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def pictures_for(render_mode: str, spec: EnvironmentSpec, original: str | None) -> Pictures:
    """Return an object that draws observations in the given render mode.

    Raises:
        ValueError: an unknown render mode.
        NotRenderable: there is no renderer, or the state can't be computed from observations.
    """
    if render_mode not in RENDER_MODES:
        raise ValueError(f"expected render_mode None or rgb_array for a surrogate, got {render_mode!r}")
    return Pictures(spec, original)


def coordinates_from_observation(spec: EnvironmentSpec) -> Callable[[Array], Array]:
    """Return a function that computes coordinates (C,) from an observation (D,).

    It uses entries that are linear in one coordinate, and pairs of entries with the sine and cosine of an angle.

    Raises:
        NotRenderable: a coordinate can't be computed from the observation.
    """
    reads = [read_of(spec, name) for name in spec.coordinate_names]
    if missing := [name for name, read in zip(spec.coordinate_names, reads, strict=True) if read is None]:
        raise NotRenderable(
            f"expected observations from which every coordinate can be computed, got none for "
            f"{missing[0]!r}: observe it, or leave render_mode out"
        )
    known = [read for read in reads if read is not None]
    return lambda observation: np.array([read(observation) for read in known])
