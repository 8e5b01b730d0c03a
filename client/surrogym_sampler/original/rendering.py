"""Pictures of given states, drawn by the original environment's own renderer.

Shapes: C coordinates; a picture is (height, width, 3) uint8.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np

from surrogym_client.environments.pictures import NotRenderable, Picture, Renderer
from surrogym_client.environments.render_modes import drawn_with, is_drawn_by_gymnasium
from surrogym_sampler.original.adapters.gymnasium_ids import settable
from surrogym_sampler.original.classic import TASKS
from surrogym_sampler.original.executables import is_executable
from surrogym_sampler.original.factories import load_factory
from surrogym_sampler.original.gymnasium import opens_task
from surrogym_sampler.original.loading import is_own
from surrogym_sampler.original.protocol import Array, Native
from surrogym_shared.spec import EnvironmentSpec

FRAMES_PER_SECOND = 30


@runtime_checkable
class Drawable(Protocol):
    """A user's environment that can be rendered: it has the additional method ``picture``."""

    def picture(self, coordinates: Array) -> Picture:
        """Return the picture of the state with coordinates (C,)."""
        ...


def renderer_of(spec: EnvironmentSpec, original: str | None = None) -> Renderer:
    """Return the renderer of a specification's environment.

    Args:
        spec: the specification. Its environment's name is used only if it is that of a built-in adapter, never to
            import a module.
        original: ``package.module:factory`` of a user's environment, which has a method ``picture``.

    Raises:
        NotRenderable: the environment has no renderer, or a package that the renderer needs is not installed.
    """
    if original is not None and is_own(original) and not is_executable(original):
        return _Own(original)
    name = original or spec.environment
    if not is_drawn_by_gymnasium(name):
        raise NotRenderable(
            f"expected original='package.module:factory' to render the environment {name!r}, got none: give "
            "the class that draws it"
        )
    return _Native(name, spec)


class _Own:
    def __init__(self, name: str) -> None:
        made = load_factory(name)()
        if not isinstance(made, Drawable):
            raise NotRenderable(
                f"expected {name} to have a method picture(coordinates), got a {type(made).__name__} without it: "
                "add the method"
            )
        self._environment = made
        self.frames_per_second = int(getattr(made, "frames_per_second", FRAMES_PER_SECOND))

    def draw(self, coordinates: Array) -> Picture:
        picture = np.asarray(self._environment.picture(coordinates))
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise NotRenderable(
                f"expected picture() to return an array (height, width, 3) of uint8, got {picture.shape} of "
                f"{picture.dtype}: convert the picture"
            )
        return picture

    def close(self) -> None:
        getattr(self._environment, "close", bool)()


class _Native:
    """A Gymnasium environment that is set to states and rendered, but never stepped."""

    def __init__(self, name: str, spec: EnvironmentSpec) -> None:
        self._name, self._spec = name, spec
        try:
            self._env: Native = gymnasium.make(name, render_mode="rgb_array").unwrapped
            self._env.reset(seed=0)
        except (ImportError, gymnasium.error.Error) as error:
            raise self._unavailable(error) from error
        self._simulator = None if opens_task(name, spec) else settable(name, self._env)
        self.frames_per_second = int(self._env.metadata.get("render_fps", FRAMES_PER_SECOND))

    def draw(self, coordinates: Array) -> Picture:
        if self._simulator is None:
            TASKS[self._name].write(self._env, coordinates)
        else:
            self._simulator.place(self._simulator.columns(self._spec.coordinate_names), coordinates)
        try:
            frame: Any = self._env.render()
        except Exception as error:  # a missing display, driver or library each raises an error of its own
            raise self._unavailable(error) from error
        return np.asarray(frame, dtype=np.uint8)

    def close(self) -> None:
        self._env.close()

    def _unavailable(self, error: Exception) -> NotRenderable:
        way_out = "".join(f" (pip install 'surrogym[{extra}]')" for _, extra in drawn_with(self._name))
        return NotRenderable(f"{self._name} can't be shown here: {error}{way_out}")
