"""The adapter for Functional Mock-up Units: ``fmu:PLANT.fmu``, or ``fmu:PLANT.json`` with the FMU's name and settings.

Their native code runs in a process of its own. The state consists of variables that can be set before the FMU is
initialised; to set a state, the FMU is initialised again. An FMU has no reward, starts and terminations, so the
specification declares them.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.fmus.archive import Archive, Declared, read_archive
from surrogym_sampler.original.fmus.choices import (
    Choices,
    described_by,
    driven,
    read_choices,
    start_values,
    step_of,
)
from surrogym_sampler.original.fmus.process import Process
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Motion, Simulated, Simulator, Taken, Variable
from surrogym_sampler.original.unrewarded import Unrewarded
from surrogym_shared.spec import MAX_DIMENSIONS, BoxAction, EnvironmentSpec
from surrogym_shared.spec.base import REWARD

UNKNOWN_LIMITS = (-1.0, 1.0)  # assumed limits of an input that declares none
SAME = 1e-9  # a variable counts as set if it is read back with at most this relative error
# To test whether a variable can be set, its start value is shifted by this share of the width of its limits, or of 2 if
# it has no limits.
SHIFT = 0.05
MOTIONS: dict[str | None, Motion] = {"rad": "turn", "rad/s": "speed", "m/s": "speed"}


def open_simulator(name: str) -> Simulator:
    """Open the FMU with this name.

    Raises:
        UnknownEnvironment: the FMU can't be used on this machine, or the settings in its JSON file don't fit.
        ImportError: fmpy is not installed.
    """
    path, choices = read_choices(name)
    return Fmu(name, read_archive(path), choices)


class Fmu(Simulator):
    """One FMU for co-simulation. A reset always begins at its start values. The observation consists of its outputs."""

    pays = False

    def __init__(self, name: str, archive: Archive, choices: Choices) -> None:
        self._name = name
        inputs, state = driven(archive, choices), described_by(archive, choices)
        if len(state) > MAX_DIMENSIONS:
            raise UnknownEnvironment(
                f"{archive.path} has {len(state)} variables that describe its state: expected at most "
                f'{MAX_DIMENSIONS}; choose some as "coordinates" in a JSON file that names the FMU'
            )
        outputs = archive.of_causality("output") or state
        self._state, self._size = state, len(state)
        self._has_snapshots = archive.snapshots
        step = self.period = step_of(archive, choices)
        self._process = Process(archive, inputs, [*state, *outputs], step, start_values(archive, choices))
        given = {v: choices.start.get(v.name, v.start) for v in archive.of_causality("parameter") if v.can_start}
        self._parameters = {v: float(value) for v, value in given.items() if value is not None}
        try:
            self.variables = _variables(state)
            limits = [choices.limits.get(v.name) or _limits(v) or UNKNOWN_LIMITS for v in inputs]
            self.action = BoxAction(low=tuple(low for low, _ in limits), high=tuple(high for _, high in limits))
            self.time_limit = round(archive.stop / step) if archive.stop and archive.stop >= step else None
            self.reset(None)
            self.rest = self.read()
            self.fixed = self._why_fixed()
            self.settable = not self.fixed
            self.notes = _notes(archive, step, inputs, limits, self._named())
            self.questions = _questions(inputs, choices)
        except StepFailed as error:
            self.close()
            raise UnknownEnvironment(f"{name} can't be started: {error}") from error
        except BaseException:
            self.close()
            raise

    def reset(self, seed: int | None) -> Array:
        del seed  # the seed has no effect, because an FMU draws no random start
        self._process.initialise()
        return self.observe()

    def step(self, action: Array) -> Taken:
        over = self._process.step(action)
        return Taken(self.observe(), 0.0, False, over)

    def read(self) -> Array:
        return self._process.values[: self._size].copy()

    def write(self, state: Array) -> None:
        if not self.settable:
            raise UnknownEnvironment(f"{self._name} can't be set to {state.tolist()}: register it with --access reset")
        self._set(state)

    def observe(self) -> Array:
        return self._process.values[self._size :].copy()

    @property
    def saves(self) -> bool:
        return self.settable or self._has_snapshots

    def save(self) -> bytes:
        """Return a snapshot: the FMU's own saved state if it can save one, else the variables that can be set."""
        if self._has_snapshots:
            return self._process.save()
        if not self.settable:
            raise StepFailed(
                "expected an FMU that can save its state or be set to a state, got an FMU that can only be reset: "
                "register it with --access reset"
            )
        return super().save()

    def restore(self, snapshot: bytes) -> None:
        if self._has_snapshots:
            self._process.restore(snapshot)
        else:
            super().restore(snapshot)

    def parameters(self) -> dict[str, float]:
        """Return the FMU's real parameters that have a start value, by name."""
        return {variable.name: value for variable, value in self._parameters.items()}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Change parameters; they take effect when the FMU is initialised, which setting a state does."""
        self._parameters = {v: values.get(v.name, value) for v, value in self._parameters.items()}
        self._process.parameters = [(v.type, v.reference, value) for v, value in self._parameters.items()]

    def close(self) -> None:
        self._process.close()

    def action_taken(self, action: Array) -> Array:
        return np.array(action, dtype=np.float64)

    def with_specification(self, spec: EnvironmentSpec, *, shows_own: bool, step_limit: float) -> Simulated:
        # Ignored: an FMU's outputs may depend on the last input, so a policy observes what the specification declares.
        del shows_own
        self._process.step_limit = step_limit
        return FmuEnvironment(self, spec)

    def _set(self, state: Array) -> None:
        self._process.initialise(
            [(v.type, v.reference, float(value)) for v, value in zip(self._state, state, strict=True)]
        )

    def _why_fixed(self) -> str:
        """Return the reason why the FMU's state can't be set; empty if a shifted start could be set and read back."""
        if calculated := [v.name for v in self._state if not v.can_start]:
            return f"the FMU calculates {', '.join(calculated)}, which has no start to set, so it can only be reset"
        wanted = np.array([_shifted(v, at) for v, at in zip(self._state, self.rest, strict=True)])
        try:
            self._set(wanted)
            got = self.read()
        except StepFailed as error:
            return f"another start of its state failed, so it can only be reset ({error})"
        finally:
            self._process.initialise()
        for variable, want, at in zip(self._state, wanted, got, strict=True):
            if abs(at - want) > SAME * max(1.0, abs(want)):
                return f"{variable.name} was started at {want:g} and read back as {at:g}, so it can only be reset"
        return ""

    def _named(self) -> list[str]:
        """Return a sentence for each variable whose name a specification can't use, with the name that replaces it."""
        return [
            f"{v.name} is called {ours.name}"
            for v, ours in zip(self._state, self.variables, strict=True)
            if v.name != ours.name
        ]


class FmuEnvironment(Unrewarded):
    """An FMU as an original environment, with one instance at a time, because each is a process."""

    parallel = False

    def __init__(self, simulator: Simulator, spec: EnvironmentSpec) -> None:
        if spec.action.kind != "box" or spec.action.size != simulator.action.size:
            raise UnknownEnvironment(
                f"expected a continuous action of {simulator.action.size} entries, one for each input of the FMU that "
                f"an action sets, got a {spec.action.kind} action of {spec.action.size}: correct the specification's "
                "action"
            )
        super().__init__(simulator, spec)


def _variables(state: Sequence[Declared]) -> tuple[Variable, ...]:
    """Return the state's variables, with names that a specification can use."""
    found: dict[str, Variable] = {}
    for one in state:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "_", one.name).strip("._-")[:60] or "variable"
        name, number = plain, 2
        while name in found or name == REWARD:
            name, number = f"{plain}_{number}", number + 1
        limits = _limits(one)
        motion = "other" if limits else MOTIONS.get(one.unit, "other")
        found[name] = Variable(name, motion, *(limits or (None, None)))
    return tuple(found.values())


def _limits(variable: Declared) -> tuple[float, float] | None:
    if variable.low is None or variable.high is None or not variable.low < variable.high:
        return None
    return variable.low, variable.high


def _shifted(variable: Declared, at: float) -> float:
    """Return another start value of a variable: its present one, ``at``, shifted within its limits."""
    low, high = _limits(variable) or (at - 1.0, at + 1.0)
    shift = SHIFT * (high - low)
    return at + shift if at + shift <= high else at - shift


def _notes(
    archive: Archive,
    step: float,
    inputs: Sequence[Declared],
    limits: Sequence[tuple[float, float]],
    named: Sequence[str],
) -> tuple[str, ...]:
    actions = ", ".join(f"{v.name} ({low:g} to {high:g})" for v, (low, high) in zip(inputs, limits, strict=True))
    lines = [f"an action sets {actions} for {step:g} s"]
    if named:
        lines.append(f"names that a specification can't use: {', '.join(named)}")
    if archive.snapshots:
        lines.append("it can save its whole state and return to it")
    return tuple(lines)


def _questions(inputs: Sequence[Declared], choices: Choices) -> tuple[str, ...]:
    unknown = [v.name for v in inputs if v.name not in choices.limits and _limits(v) is None]
    lines = []
    if unknown:
        low, high = UNKNOWN_LIMITS
        lines.append(
            f"action: {', '.join(unknown)} declares no min and max, so {low:g} to {high:g} is assumed: give its limits "
            'under "actions" of a JSON file, and describe it again'
        )
    lines.append("start: an FMU always begins at its start values. Give ranges if episodes should begin elsewhere")
    return tuple(lines)
