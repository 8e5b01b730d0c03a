"""The adapter for process control by pc-gym: ``pcgym:cstr``, its documented stirred tank, or ``pcgym:FILE.json`` with
parameters.

The state is the attribute ``state``. In an episode, setpoints and disturbances follow a schedule. After a state is set,
they keep the values that were set.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_sampler.original.adapters.parts import OfParts, action_of
from surrogym_sampler.original.adapters.pcgym.file import RANGES, check_model, read_parameters
from surrogym_sampler.original.errors import OriginalError, UnknownEnvironment
from surrogym_sampler.original.gymnasium import native_action
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulator, Taken, Variable
from surrogym_sampler.original.state_parts import StatePart

STIRRED_TANK: dict[str, Any] = {  # The parameters in the quick start of pc-gym 0.1.8.
    "model": "cstr",
    "N": 100,
    "tsim": 25,
    "SP": {"Ca": [0.85] * 50 + [0.9] * 50},
    "a_space": {"low": [295.0], "high": [302.0]},
    "o_space": {"low": [0.7, 300.0, 0.8], "high": [1.0, 350.0, 0.9]},
    "x0": [0.8, 330.0, 0.8],
}
SCHEDULES = ("SP", "disturbances")  # parameters with one value for each step; pc-gym uses the first N values only
REFUSED = {
    "a_delta": "actions are changes, and their sum is not part of the state",
    "uncertainty_percentages": "its parameters are drawn by a generator that can't be seeded",
    "noise": "its noise comes from a generator that can't be seeded",
}


def open_simulator(name: str) -> Simulator:
    """Open a process of pc-gym.

    Raises:
        UnknownEnvironment: the file of parameters does not exist, or its parameters can't be used.
        ImportError: pc-gym is not installed.
    """
    parameters = parameters_of(name.partition(":")[2])
    with _silence():
        from pcgym import make_env, model_classes

    _require_model(name, parameters["model"], model_classes)
    _as_before()
    try:
        with _silence():
            env = make_env(parameters)
        check_model(name, parameters, env.model.info())
        return Process(name, env)
    except (ImportError, OriginalError):
        raise
    except Exception as error:  # pc-gym may raise an exception of any class
        raise UnknownEnvironment(
            f"pc-gym refused the parameters of {name}: {type(error).__name__}: {error}; its documentation lists what "
            "make_env needs"
        ) from error


@contextmanager
def _silence() -> Iterator[None]:
    """Silence warnings that a user of pc-gym can do nothing about: about the syntax of its packages, and about its own
    spaces."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)
        warnings.filterwarnings("ignore", ".*precision lowered by casting", UserWarning)
        yield


def _as_before() -> None:
    """Set CasADi to the NumPy behaviour for which pc-gym was written. Newer versions of CasADi warn about
    it otherwise."""
    from casadi import GlobalOptions

    with suppress(AttributeError):  # older versions of CasADi lack the setting, and always behave in this way
        GlobalOptions.setNumpyMode(-1)


def _require_model(name: str, model: str, classes: Any) -> None:
    found = [key for key, value in vars(classes).items() if isinstance(value, type) and hasattr(value, "info")]
    known = sorted(key for key in found if key.islower())  # pc-gym's make_env accepts only names in lower case
    if model not in known:
        raise UnknownEnvironment(f"{name}: expected the parameter model to be one of {', '.join(known)}, got {model!r}")


def parameters_of(which: str) -> dict[str, Any]:
    """Return the parameters for ``pcgym.make_env``: those of the built-in process ``cstr``, or those in a JSON file.

    Raises:
        UnknownEnvironment: ``which`` is neither ``cstr`` nor an existing file, or the file has parameters that can't be
            used.
    """
    given = STIRRED_TANK if which == "cstr" else _read(which)
    for key, why in REFUSED.items():
        if given.get(key):
            raise UnknownEnvironment(
                f"pcgym:{which} sets {key}, which is not supported: {why}; remove it from the parameters"
            )
    spaces = {key: {end: np.array(given[key][end], float) for end in ("low", "high")} for key in RANGES if key in given}
    schedules = {
        key: {name: values[: given["N"]] for name, values in given[key].items()} for key in SCHEDULES if given.get(key)
    }
    return {**given, **spaces, **schedules, "x0": np.array(given["x0"], dtype=float)}


def _read(which: str) -> dict[str, Any]:
    path = Path(which)
    if path.suffix != ".json" or not path.is_file():
        raise UnknownEnvironment(
            f"expected pcgym:cstr, or pcgym:FILE.json with a file of parameters for pcgym.make_env, got 'pcgym:{which}'"
        )
    return read_parameters(path)


class Process(OfParts):
    """One process of pc-gym. Its observation is its state, in the units of the process."""

    def __init__(self, name: str, env: Any) -> None:
        self._name, self._env = name, env
        with _silence():
            env.reset()
        self._schedule = (env.SP, getattr(env, "disturbances", {}))
        super().__init__([_State(env)])
        setpoints, disturbances = self._schedule
        schedule = {f"{name}_setpoint": values for name, values in setpoints.items()} | dict(disturbances)
        held = [v.name for v in self.variables if v.motion == "held"]
        self.scheduled = {name: (float(np.min(schedule[name])), float(np.max(schedule[name]))) for name in held}
        self.action = action_of(name, env.action_space)
        self.time_limit = int(env.N) - 1  # pc-gym ends an episode one step before N samples

    def reset(self, seed: int | None) -> Array:
        del seed  # the seed has no effect, because a reset draws no random numbers
        self._env.SP, disturbances = self._schedule
        if disturbances:
            self._env.disturbances = disturbances
        with _silence():  # each reset creates the spaces again, which may warn
            self._env.reset()
        self._show_setpoints()
        return self.observe()

    def _show_setpoints(self) -> None:
        """Write the first setpoints of the schedule into the state. After a reset, pc-gym shows the setpoints in its
        parameter ``x0`` instead, although its reward follows the schedule."""
        at = self._env.Nx_oracle
        for i, values in enumerate(self._schedule[0].values()):
            self._env.state[at + i] = values[0]

    def step(self, action: Array) -> Taken:
        _, reward, over, _, _ = self._env.step(native_action(self.action, action).astype(np.float64))
        timed_out = self._env.t >= self._env.N - 1
        return Taken(self.observe(), float(np.sum(reward)), bool(over) and not timed_out, bool(over) and timed_out)

    def observe(self) -> Array:
        return self.read()

    def close(self) -> None:
        self._env.close()


class _State(StatePart):
    """The state of a process: the model's states, its setpoints and its disturbances."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._setpoints = list(env.SP)
        self._disturbances = [
            k for k in env.model.info()["disturbances"] or () if k in getattr(env, "disturbances", {})
        ]
        spaces = [env.env_params[key] for key in ("o_space", "disturbance_bounds") if key in env.env_params]
        low, high = (np.concatenate([space[end] for space in spaces]) for end in ("low", "high"))
        states = list(env.model.info()["states"])
        names = [*states, *(f"{k}_setpoint" for k in self._setpoints), *self._disturbances]
        self.variables = tuple(
            Variable(name, "other" if name in states else "held", float(a), float(b))
            for name, a, b in zip(names, low, high, strict=False)
        )

    def read(self) -> Array:
        return np.array(self._env.state, dtype=np.float64)

    def write(self, values: Array) -> None:
        env = self._env
        env.state, env.t, env.done = values.copy(), 0, False
        at = env.Nx_oracle
        env.SP = {k: [v] * env.N for k, v in zip(self._setpoints, values[at:], strict=False)}
        at += len(self._setpoints)
        if self._disturbances:
            held = zip(self._disturbances, values[at:], strict=True)
            env.disturbances = {k: np.full(env.N + 1, v) for k, v in held}
