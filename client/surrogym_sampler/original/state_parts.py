"""The parts of a simulator's state: MuJoCo's own state, the numbers in an attribute, and what a reset draws into the
model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from surrogym_sampler.original.protocol import Array, Native
from surrogym_sampler.original.simulator import Motion, Variable

VELOCITY = "_velocity"
AXES = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
FREE, BALL, SLIDE, HINGE = range(4)  # numbers of MuJoCo's joint types (mjtJoint)
RESETS = 4  # number of resets that are compared to find the entries of a model that a reset draws
# fields of a MuJoCo model that tasks draw at random at a reset
DRAWN = ("body_pos", "geom_pos", "geom_size", "site_pos")


class StatePart(Protocol):
    """A part of a simulator's state: some of its variables, which are read and written together."""

    variables: tuple[Variable, ...]

    def read(self) -> Array:
        """Return the values (n,) of the part's variables."""
        ...

    def write(self, values: Array) -> None:
        """Set the part's variables to values (n,)."""
        ...

    def save(self) -> Array:
        """Return everything in this part that the next step depends on, as k numbers (k,)."""
        return self.read()

    def restore(self, saved: Array) -> None:
        """Return to the state whose k numbers (k,) ``save`` returned."""
        self.write(saved)


class MujocoState(StatePart):
    """Positions, velocities, activations of actuators and mocap poses of a MuJoCo model.

    MuJoCo's full integration state is recorded at the start. Each write first restores that record, and then sets the
    given values. So no time, warm start of the solver, applied force or active constraint of earlier steps remains.
    """

    def __init__(self, model: Native, data: Native) -> None:
        import mujoco

        self._mujoco, self._model, self._data = mujoco, model, data
        self._kept = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        self._rest = np.zeros(mujoco.mj_stateSize(model, self._kept))
        mujoco.mj_getState(model, data, self._rest, self._kept)
        joints = [_Joint(model, i) for i in range(model.njnt)]
        positions = [variable for joint in joints for variable in joint.positions]
        velocities = [Variable(name, "speed") for joint in joints for name in joint.velocities]
        self.variables = (*positions, *velocities, *self._activations(), *self._mocap())

    def read(self) -> Array:
        data = self._data
        return np.concatenate([data.qpos, data.qvel, data.act, data.mocap_pos.ravel(), data.mocap_quat.ravel()])

    def write(self, values: Array) -> None:
        data = self._data
        self._mujoco.mj_setState(self._model, data, self._rest, self._kept)
        data.time = 0.0
        data.qacc_warmstart[:] = 0.0
        at = 0
        for array in (data.qpos, data.qvel, data.act, data.mocap_pos, data.mocap_quat):
            array[:] = values[at : at + array.size].reshape(array.shape)
            at += array.size
        self._mujoco.mj_normalizeQuat(self._model, data.qpos)
        self._mujoco.mj_forward(self._model, data)

    def save(self) -> Array:
        full = np.zeros_like(self._rest)
        self._mujoco.mj_getState(self._model, self._data, full, self._kept)
        return full

    def restore(self, saved: Array) -> None:
        self._mujoco.mj_setState(self._model, self._data, saved, self._kept)
        self._mujoco.mj_forward(self._model, self._data)
        # mj_forward changed the solver's warm start, so restore once more
        self._mujoco.mj_setState(self._model, self._data, saved, self._kept)

    def _activations(self) -> list[Variable]:
        by_entry: dict[int, str] = {}
        for i in range(self._model.nu):
            first, number = int(self._model.actuator_actadr[i]), int(self._model.actuator_actnum[i])
            name = self._model.actuator(i).name or f"actuator{i}"
            by_entry |= {first + k: f"{name}_activation" + (f"{k}" if number > 1 else "") for k in range(number)}
        return [Variable(by_entry.get(i, f"activation{i}")) for i in range(self._model.na)]

    def _mocap(self) -> list[Variable]:
        mocap_ids = list(self._model.body_mocapid)
        names = [self._model.body(mocap_ids.index(i)).name or f"mocap{i}" for i in range(self._model.nmocap)]
        places = [f"{name}_mocap_{axis}" for name in names for axis in AXES]
        return [Variable(name) for name in (*places, *(f"{name}_mocap_{q}" for name in names for q in QUATERNION))]


class _Joint:
    """The position and velocity variables of one joint."""

    def __init__(self, model: Native, index: int) -> None:
        name, kind = model.joint(index).name or f"joint{index}", int(model.jnt_type[index])
        limits = tuple(map(float, model.jnt_range[index])) if model.jnt_limited[index] else (None, None)
        turning = [f"{name}{VELOCITY}_r{axis}" for axis in AXES]
        if kind == FREE:
            self.positions = [*(Variable(f"{name}_{a}", "slide") for a in AXES), *_quaternion(name)]
            self.velocities = [*(f"{name}{VELOCITY}_{axis}" for axis in AXES), *turning]
        elif kind == BALL:
            self.positions, self.velocities = _quaternion(name), turning
        else:
            driven = _is_driven(model, index)
            motion: Motion = "slide" if kind == SLIDE else "turn"
            held = not driven and kind == SLIDE and not _can_touch(model, int(model.jnt_bodyid[index]))
            self.positions = [Variable(name, "held" if held else motion, limits[0], limits[1], driven)]
            self.velocities = [f"{name}{VELOCITY}"]


def _is_driven(model: Native, joint: int) -> bool:
    """Return whether an actuator acts on the joint itself."""
    on_joints = model.actuator_trntype == 0  # transmission type mjTRN_JOINT: the actuator acts on a joint
    return bool((on_joints & (model.actuator_trnid[:, 0] == joint)).any())


def _can_touch(model: Native, body: int) -> bool:
    """Return whether gravity or another body can move a body. A body that is only displayed, such as a target, neither
    falls nor touches."""
    inside = {body}
    for child in range(body + 1, model.nbody):  # MuJoCo numbers children after their parents
        if int(model.body_parentid[child]) in inside:
            inside.add(child)
    geoms = [i for i in range(model.ngeom) if int(model.geom_bodyid[i]) in inside]
    return any(model.geom_contype[i] or model.geom_conaffinity[i] for i in geoms) or len(inside) > 1


def _quaternion(name: str) -> list[Variable]:
    return [Variable(f"{name}_{q}", "other", -1.0, 1.0) for q in QUATERNION]


class Attribute(StatePart):
    """The numbers in an attribute of an object: an array, or a list or tuple of numbers."""

    def __init__(self, owner: Any, attribute: str, motion: Motion = "other") -> None:
        self._owner, self._attribute = owner, attribute
        self.variables = tuple(Variable(f"{attribute}{i}", motion) for i in range(self.read().size))

    def read(self) -> Array:
        return np.array(getattr(self._owner, self._attribute), dtype=np.float64).ravel()

    def write(self, values: Array) -> None:
        before = getattr(self._owner, self._attribute)
        if isinstance(before, np.ndarray):
            setattr(self._owner, self._attribute, values.astype(before.dtype).reshape(before.shape))
        else:
            numbers = [_like(old, new) for old, new in zip(before, values.tolist(), strict=True)]
            made = type(before)(*numbers) if hasattr(before, "_fields") else type(before)(numbers)
            # the attribute is replaced, because a tuple can't be changed in place
            setattr(self._owner, self._attribute, made)


def _like(old: Any, new: float) -> Any:
    """Return the number ``new`` in the type of ``old``. For a bool, this is whether it is at least 0.5. For an int,
    such as an index, it is an int if ``new`` is whole. Otherwise it is a float."""
    if isinstance(old, bool | np.bool_):
        return new >= 0.5
    return int(new) if isinstance(old, int | np.integer) and new == int(new) else new


def holds_numbers(owner: Any, attribute: str) -> bool:
    """Return whether an attribute contains a state that can be written: an array, list or tuple of finite numbers."""
    value = getattr(owner, attribute, None)
    flat = isinstance(value, list | tuple) and all(np.ndim(entry) == 0 for entry in value)
    if not (flat or isinstance(value, np.ndarray)):
        return False
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return numbers.size > 0 and bool(np.isfinite(numbers).all()) and _can_be_written(owner, attribute)


def _can_be_written(owner: Any, attribute: str) -> bool:
    """Return whether an attribute can be set to its present value. A property may refuse it."""
    part = Attribute(owner, attribute)
    try:
        part.write(part.read())
    except Exception:  # an environment may raise any exception; then it can only be reset
        return False
    return True


class DrawnIntoModel(StatePart):
    """Entries of a MuJoCo model that a task draws at random at each reset, such as the position of a target."""

    def __init__(self, model: Native, places: Sequence[tuple[str, int, int]]) -> None:
        self._model, self._places = model, places
        self.variables = tuple(Variable(_name_of(model, *place), "held") for place in places)

    def read(self) -> Array:
        return np.array([getattr(self._model, field)[i, k] for field, i, k in self._places], dtype=np.float64)

    def write(self, values: Array) -> None:
        for (field, i, k), value in zip(self._places, values, strict=True):
            getattr(self._model, field)[i, k] = value


def mujoco_parts(model: Native, data: Native, reset: Callable[[int], object]) -> list[StatePart]:
    """Return the parts of a MuJoCo environment's state: MuJoCo's own, and the entries that ``reset`` with a seed draws
    into the model, if any."""
    seen = []
    for seed in range(RESETS):
        reset(seed)
        seen.append(drawable(model))
    reset(0)
    places = drawn_between(seen)
    parts: list[StatePart] = [MujocoState(model, data)]
    return [*parts, DrawnIntoModel(model, places)] if places else parts


def drawable(model: Native) -> dict[str, Array]:
    """Return copies of the fields of a model into which a task may draw random values."""
    return {field: np.array(getattr(model, field)) for field in DRAWN}


def drawn_between(seen: Sequence[dict[str, Array]]) -> list[tuple[str, int, int]]:
    """Return field, row and column of the entries that differ between copies of a model."""
    return [
        (field, int(i), int(k))
        for field in DRAWN
        for i, k in np.argwhere(np.any([copy[field] != seen[0][field] for copy in seen], axis=0))
    ]


def _name_of(model: Native, field: str, row: int, column: int) -> str:
    kind, _, what = field.partition("_")
    owner = getattr(model, kind)(row).name or f"{kind}{row}"
    return f"{owner}_{AXES[column]}" if what == "pos" else f"{owner}_size{column}"
