"""Simulators whose state is read and set in several parts, such as positions, velocities and goals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.gymnasium import packed, unpacked
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulator, random_factor
from surrogym_sampler.original.state_parts import StatePart
from surrogym_shared.spec import MAX_DIMENSIONS, BoxAction, DiscreteAction, MultiDiscreteAction
from surrogym_shared.spec.actions import Action


class OfParts(Simulator):
    """A simulator whose state consists of parts. The first part is written last, because writing it runs MuJoCo's
    kinematics, which depend on the other parts."""

    def __init__(self, parts: Sequence[StatePart], model: Any = None, data: Any = None) -> None:
        self._parts = tuple(parts)
        self._model, self._data = model, data
        self._masses = None if model is None else np.array(model.body_mass)
        self.variables = tuple(variable for part in parts for variable in part.variables)
        self.rest = self.read()

    def read(self) -> Array:
        return np.concatenate([part.read() for part in self._parts])

    def write(self, state: Array) -> None:
        ends = np.cumsum([len(part.variables) for part in self._parts])[:-1]
        for part, values in reversed(list(zip(self._parts, np.split(state, ends), strict=True))):
            part.write(values)

    def save(self) -> bytes:
        return packed(np.concatenate([part.save() for part in self._parts]))

    def restore(self, snapshot: bytes) -> None:
        ends = np.cumsum([len(part.save()) for part in self._parts])
        saved = unpacked(snapshot, (int(ends[-1]),))
        for part, values in reversed(list(zip(self._parts, np.split(saved, ends[:-1]), strict=True))):
            part.restore(values)

    def touches(self) -> bool:
        return self._data is not None and int(self._data.ncon) > 0

    def parameters(self) -> dict[str, float]:
        """Return the parameters of a MuJoCo model by name: ``mass.BODY``, ``damping.JOINT``, ``friction.GEOM``
        (sliding) and ``gear.ACTUATOR``. Elements without a name or with a value of 0 are left out."""
        return {name: float(rows[at]) for name, (rows, at) in self._places.items()}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Change parameters of the MuJoCo model, by name. A body's inertia changes in proportion to its mass. Raises
        ``ValueError``, and changes nothing, if a mass is not above 0, or damping or friction is below 0."""
        import mujoco

        for name, value in values.items():
            if not (value > 0 if name.startswith("mass.") else value >= 0 or name.startswith("gear.")):
                least = "above 0" if name.startswith("mass.") else "of at least 0"
                raise ValueError(f"expected {name} {least}, got {value:g}: give a value that a machine can have")
        for name, value in values.items():
            rows, at = self._places[name]
            if name.startswith("mass."):
                self._model.body_inertia[at] *= value / float(rows[at])
            rows[at] = value
        qpos, qvel = self._data.qpos.copy(), self._data.qvel.copy()
        mujoco.mj_setConst(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = qpos, qvel

    @cached_property
    def _places(self) -> dict[str, tuple[Any, Any]]:
        """Array and index of each parameter. A parameter stays one when its value becomes 0."""
        return {} if self._model is None else {name: (rows, at) for name, rows, at in _parameters(self._model)}

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        if self._model is None or self._masses is None:
            super().perturb(rng, sigma)
            return
        for body, mass in enumerate(self._masses):
            self._model.body_mass[body] = mass * random_factor(rng, sigma)


def _parameters(model: Any) -> list[tuple[str, Any, Any]]:
    """Return name, array and index into the array of each parameter of a MuJoCo model."""
    found: list[tuple[str, Any, Any]] = []
    for kind, count, read, rows, entry in (
        ("mass", model.nbody, model.body, model.body_mass, None),
        ("damping", model.njnt, model.joint, model.dof_damping, "dof"),
        ("friction", model.ngeom, model.geom, model.geom_friction, 0),
        ("gear", model.nu, model.actuator, model.actuator_gear, 0),
    ):
        for index in range(count):
            name = read(index).name
            at = int(model.jnt_dofadr[index]) if entry == "dof" else index if entry is None else (index, entry)
            if name and float(rows[at]) > 0:
                found.append((f"{kind}.{name}", rows, at))
    return found


def action_of(name: str, space: Any) -> Action:
    """Convert a Gymnasium action space to a specification's action.

    Args:
        name: the environment, for messages.
        space: the action space.

    Raises:
        UnknownEnvironment: no specification can express the space or its bounds.
    """
    kind = type(space).__name__
    shape: tuple[int, ...] = getattr(space, "shape", None) or ()
    if len(shape) == 1 and not 1 <= shape[0] <= MAX_DIMENSIONS:
        raise UnknownEnvironment(
            f"{name} has an action of {shape[0]} entries: expected 1 to {MAX_DIMENSIONS}; write a wrapper class that "
            "chooses them (docs/how-to/own-environment.md)"
        )
    if kind == "Box" and len(space.shape) == 1 and np.isfinite([space.low, space.high]).all():
        return BoxAction(low=tuple(map(float, space.low)), high=tuple(map(float, space.high)))
    if kind == "Discrete" and int(space.start) == 0:
        return DiscreteAction(n=int(space.n))
    if kind == "MultiDiscrete" and len(space.shape) == 1 and not np.any(space.start):
        return MultiDiscreteAction(nvec=tuple(map(int, space.nvec)))
    raise UnknownEnvironment(
        f"{name} has the action space {space}: expected a Box with one row of finite bounds, Discrete or "
        "MultiDiscrete from 0; write a wrapper class (docs/how-to/own-environment.md)"
    )


def flat(name: str, observation: Any) -> Array:
    """Return an observation as one row of numbers (D,). Entries of a dictionary are in alphabetical order of their
    names.

    Raises:
        UnknownEnvironment: the observation contains an image, or a value that is not a number.
    """
    entries = [observation[key] for key in sorted(observation)] if isinstance(observation, dict) else [observation]
    arrays = [np.asarray(entry) for entry in entries]
    if any(sum(size > 1 for size in a.shape) > 1 or a.dtype.kind not in "fiub" for a in arrays):
        raise UnknownEnvironment(
            f"{name} observes images, or values that are not numbers: expected a row of numbers, or a dictionary of "
            "rows; write a class that gives them (docs/how-to/own-environment.md)"
        )
    return np.concatenate([a.astype(np.float64).ravel() for a in arrays])
