"""The adapter for a MuJoCo model in a file: ``mujoco:FILE.xml`` (MJCF or URDF) or ``mujoco:FILE.mjb``.

The state consists of the model's variables: positions, velocities, activations. An action sets its controls. A model
has no reward, starts and terminations, so the specification declares them.

Shapes: n steps, C coordinates, F action entries.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_sampler.original.adapters.parts import OfParts
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.gymnasium import wrapped
from surrogym_sampler.original.periods import CLOSE
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulated, Taken
from surrogym_sampler.original.state_parts import MujocoState
from surrogym_sampler.original.unrewarded import Unrewarded
from surrogym_shared.spec import MAX_DIMENSIONS, BoxAction, EnvironmentSpec

PREFIX = "mujoco:"
PERIOD = 0.02  # seconds for which an action is held, about, until a specification declares a sampling period
BEGIN = 1.0  # time at which rollouts begin, in seconds
UNKNOWN_LIMITS = (-1.0, 1.0)  # assumed limits of a control that declares none


def open_simulator(name: str) -> MujocoFile:
    """Open the MuJoCo model in a file.

    Raises:
        UnknownEnvironment: the file can't be read, or its model has no controls, or too many.
        ImportError: MuJoCo is not installed.
    """
    import mujoco

    path = Path(name.removeprefix(PREFIX))
    if not path.is_file():
        raise UnknownEnvironment(f"expected mujoco:FILE.xml or mujoco:FILE.mjb, got {path}, which is no file")
    read = mujoco.MjModel.from_binary_path if path.suffix == ".mjb" else mujoco.MjModel.from_xml_path
    try:
        model = read(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise UnknownEnvironment(
            f"expected a file that MuJoCo can load, got {path}: {' '.join(str(error).split())}; correct the file"
        ) from error
    return MujocoFile(name, model)


class MujocoFile(OfParts):
    """A MuJoCo model that was read from a file. A reset begins at its first keyframe, or else at its initial state."""

    pays = False
    period: float

    def __init__(self, name: str, model: Any) -> None:
        import mujoco

        self._name, self._mujoco = name, mujoco
        if not 1 <= model.nu <= MAX_DIMENSIONS or not model.nv or model.nmocap:
            raise UnknownEnvironment(
                f"expected a MuJoCo model with joints, 1 to {MAX_DIMENSIONS} actuators and no mocap bodies, got "
                f"{model.njnt} joints, {model.nu} actuators and {model.nmocap} mocap bodies in {name}: change the file"
            )
        data = mujoco.MjData(model)
        self._restarted(model, data)
        super().__init__([MujocoState(model, data)], model, data)
        controls = zip(model.actuator_ctrlrange.tolist(), model.actuator_ctrllimited, strict=True)
        limits = [tuple(ends) if limited else UNKNOWN_LIMITS for ends, limited in controls]
        self.action = BoxAction(low=tuple(low for low, _ in limits), high=tuple(high for _, high in limits))
        self._hold(max(1, round(PERIOD / model.opt.timestep)))
        # Coordinates that were matched to variables by their places, each as "COORDINATE = VARIABLE".
        self.matched: tuple[str, ...] = ()

    def require_period(self, name: str, spec: EnvironmentSpec) -> None:
        """Hold an action for the specification's sampling period. Raises ``UnknownEnvironment`` if it declares none, or
        if the period is not a whole number of the model's time steps."""
        timestep = float(self._model.opt.timestep)
        if spec.sampling_period is None:
            raise UnknownEnvironment(
                f"expected a specification with sampling_period, the seconds for which {name} holds an action, "
                "got one without: declare it"
            )
        self._hold(round(spec.sampling_period / timestep))
        if self._substeps < 1 or abs(self.period / spec.sampling_period - 1) > CLOSE:
            raise UnknownEnvironment(
                f"expected a sampling_period that is a whole number of the time steps of {name}, {timestep:g} s, "
                f'got {spec.sampling_period:g} s: change <option timestep="..."/> in the file'
            )

    def _hold(self, substeps: int) -> None:
        """Hold an action for so many time steps."""
        self._substeps, self.period = substeps, float(substeps * self._model.opt.timestep)
        controls = ", ".join(self._model.actuator(i).name or f"actuator{i}" for i in range(self._model.nu))
        unlimited = "" if all(self._model.actuator_ctrllimited) else "; one without a ctrlrange is taken as -1 to 1"
        self.notes = (f"an action sets {controls} for {self.period:g} s{unlimited}",)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the index into the state for each name. If not all are names of the file's variables, they match these
        in their order.

        Raises:
            UnknownEnvironment: there are other numbers of names and of variables, or both have a name in another place.
        """
        known = [variable.name for variable in self.variables]
        if set(names) <= set(known):
            return super().columns(names)
        moved = [one for one, other in zip(names, known, strict=False) if one != other and one in known]
        if len(names) != len(known) or moved:
            raise UnknownEnvironment(
                f"expected coordinates with the names of the variables of {self._name}, {', '.join(known)}, or as many "
                f"in this order, got {', '.join(names)}: rename the joints in the file, or remove those that the plant "
                "lacks"
            )
        self.matched = tuple(f"{one} = {other}" for one, other in zip(names, known, strict=True) if one != other)
        return list(range(len(names)))

    def reset(self, seed: int | None) -> Array:
        del seed  # a file declares one start
        self._restarted(self._model, self._data)
        return self.observe()

    def step(self, action: Array) -> Taken:
        data, kinds = self._data, self._mujoco.mjtWarning
        faults = [data.warning[kind] for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)]
        for fault in faults:
            fault.number = 0
        data.ctrl[:] = action
        self._mujoco.mj_step(self._model, data, self._substeps)
        state = self.read()
        # MuJoCo goes on from its initial state after a step that diverged
        if any(fault.number for fault in faults) or not np.isfinite(state).all():
            raise StepFailed(f"{self._name} diverged: use a smaller timestep in the file, or narrower sampling ranges")
        return Taken(state, 0.0, False, False)

    def observe(self) -> Array:
        return self.read()

    def close(self) -> None:
        if "_threads" in self.__dict__:
            self._threads[0].close()

    def with_specification(self, spec: EnvironmentSpec, *, shows_own: bool, step_limit: float) -> Simulated:
        del shows_own, step_limit
        return MujocoEnvironment(self, spec)

    def steps_from(self, columns: list[int], coordinates: Array, actions: Array) -> Array:
        """Take n steps, each from coordinates (n, C) with an action (n, F), on all cores, and return the state (n, V)
        after each. The state after a step that diverged is not a number."""
        pool, datas = self._threads
        kind = self._mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty(self._mujoco.mj_stateSize(self._model, kind))
        self._parts[0].write(self.rest)
        self._mujoco.mj_getState(self._model, self._data, start, kind)
        # MuJoCo's state begins with the time and the variables. After a step that diverged, MuJoCo continues from its
        # initial state at time 0. A rollout that began at another time then ends at a wrong time, which shows that. The
        # earlier controls of an actuator with a delay have times too: of each, the history has two numbers, then these.
        start[0] += BEGIN
        if getattr(self._model, "nhistory", 0):
            at = self._mujoco.mj_stateSize(self._model, kind & (self._mujoco.mjtState.mjSTATE_HISTORY - 1))
            for begin, (count, _) in zip(self._model.actuator_historyadr, self._model.actuator_history, strict=True):
                start[at + begin + 2 : at + begin + 2 + count] += BEGIN
        start, variables = np.tile(start, (len(coordinates), 1)), np.arange(1, 1 + len(self.variables))
        start[:, variables[columns]] = coordinates
        held = np.repeat(np.asarray(actions, dtype=np.float64)[:, None], self._substeps, axis=1)
        reached = pool.rollout(self._model, datas, start, held)[0][:, -1, : 1 + len(self.variables)]
        reached[np.abs(reached[:, 0] - start[:, 0] - self.period) > CLOSE * self.period] = np.nan
        return np.asarray(reached[:, 1:])

    @cached_property
    def _threads(self) -> tuple[Any, list[Any]]:
        """A pool of threads, and data for each of them."""
        from mujoco.rollout import Rollout

        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return Rollout(nthread=count), [self._mujoco.MjData(self._model) for _ in range(count)]

    def _restarted(self, model: Any, data: Any) -> None:
        if model.nkey:
            self._mujoco.mj_resetDataKeyframe(model, data, 0)
        else:
            self._mujoco.mj_resetData(model, data)
        self._mujoco.mj_forward(model, data)


class MujocoEnvironment(Unrewarded):
    """A MuJoCo model as an original environment."""

    simulator: MujocoFile

    def steps_from(self, coordinates: Array, actions: Array) -> Array:
        """Take n steps, each from coordinates (n, C) with an action (n, F), on all cores, and return the coordinates
        (n, C) after each. Those after a step that diverged are not numbers."""
        reached = self.simulator.steps_from(self._columns, coordinates, actions)
        return wrapped(self._spec, reached[:, self._columns])
