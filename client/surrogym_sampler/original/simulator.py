"""The interface of an adapter to a simulator, and the original environment made from a simulator and a
specification."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from surrogym_sampler.original.errors import NotPerturbable, StepFailed, UnknownEnvironment
from surrogym_sampler.original.gymnasium import native_action, packed, unpacked, wrapped
from surrogym_sampler.original.periods import require_period
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.actions import Action

SMALLEST_FACTOR = 0.05  # smallest factor on a mass or a length, so that it stays positive under any perturbation
Motion = Literal["slide", "turn", "speed", "held", "other"]


def random_factor(rng: np.random.Generator, sigma: float) -> float:
    """Draw a factor for a mass or a length, with mean 1 and standard deviation ``sigma``."""
    return max(SMALLEST_FACTOR, 1.0 + sigma * float(rng.standard_normal()))


@dataclass(frozen=True)
class Variable:
    """One number of a simulator's state.

    Attributes:
        name: the variable's name.
        motion: ``slide`` along a line, ``turn`` about an axis, ``speed``, ``held`` through an episode (a goal, a
            setpoint), or ``other``.
        low: the simulator's own lower limit; None if it has none.
        high: the simulator's own upper limit; None if it has none.
        driven: whether an actuator acts on the joint itself.
    """

    name: str
    motion: Motion = "other"
    low: float | None = None
    high: float | None = None
    driven: bool = False

    @property
    def limited(self) -> bool:
        return self.low is not None and self.high is not None

    @property
    def mechanical(self) -> bool:
        return self.motion in ("slide", "turn", "speed")


@dataclass(frozen=True)
class Taken:
    """The results of one step of a simulator; ``observation`` is the simulator's own (D,)."""

    observation: Array
    reward: float
    terminated: bool
    truncated: bool


class Simulator(ABC):
    """One open simulator, after a first reset.

    Attributes:
        settable: whether the state can be set.
        fixed: part of a sentence: why the state can't be set, and what follows from that.
        shows: whether ``observe`` computes the observation of the current state, instead of returning that of the last
            step.
        pays: whether steps have a reward; otherwise the specification has to declare it.
        action: the action space.
        variables: the V variables of the state.
        rest: values (V,) of the variables that are not coordinates when a state is set.
        time_limit: largest number of steps in an episode; None if there is no limit.
        period: seconds from one step to the next; None if unknown.
        scheduled: variables that a schedule sets, such as setpoints, with their smallest and largest value in it. They
            are coordinates, even if a few steps show only one value.
        shown_limits: declared limits (D, 2) of the entries of the observation, infinite where none are declared.
        notes: findings for a description, one sentence each.
        questions: questions to a person who reads a description, one sentence each.
    """

    settable = True
    shown_limits: Array | None = None
    fixed = "its state can't be read: the observation is used as its state, and it can only be reset"
    shows = True
    pays = True
    action: Action
    variables: tuple[Variable, ...]
    rest: Array
    time_limit: int | None = None
    period: float | None = None
    scheduled: Mapping[str, tuple[float, float]] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()

    @property
    def saves(self) -> bool:
        """Whether the simulator can return to a saved state."""
        return self.settable

    @abstractmethod
    def reset(self, seed: int | None) -> Array:
        """Begin an episode, and return the observation (D,)."""

    @abstractmethod
    def step(self, action: Array) -> Taken:
        """Apply an action (F,), and return the results of the step."""

    @abstractmethod
    def read(self) -> Array:
        """Return the V variables of the state (V,)."""

    @abstractmethod
    def write(self, state: Array) -> None:
        """Set the V variables of the state (V,), and clear all other memory of earlier steps."""

    def save(self) -> bytes:
        """Return everything that the next step depends on as a snapshot: more than ``read`` returns, if a solver has a
        memory. Raises ``StepFailed`` if the simulator can't return to a state."""
        if not self.saves:
            raise StepFailed(
                "expected a simulator that can return to a saved state, got one that can only be reset: register it "
                "with --access reset"
            )
        return packed(self.read())

    def restore(self, snapshot: bytes) -> None:
        """Return to the state in a snapshot that ``save`` made."""
        self.write(unpacked(snapshot, self.read().shape))

    @abstractmethod
    def observe(self) -> Array:
        """Return the observation (D,) of the current state, without a step."""

    def touches(self) -> bool:
        """Return whether bodies touch each other in the current state; False if the simulator has no contacts."""
        return False

    def parameters(self) -> dict[str, float]:
        """Return the physical parameters that can be changed, with their current values; none by default."""
        return {}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Change the given ones of ``parameters``, from the next state that is set on."""
        if values:
            raise NotImplementedError(f"{type(self).__name__} has no parameters")

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        """Multiply the original masses by normal factors of mean 1 and standard deviation ``sigma``.

        Raises:
            NotPerturbable: the simulator's masses are unknown.
        """
        del rng, sigma
        raise NotPerturbable(
            "expected a MuJoCo model, or classic control with its built-in specification, for a perturbation, got "
            "another environment: write a class with changed physics, and give it with --env"
        )

    def require_period(self, name: str, spec: EnvironmentSpec) -> None:
        """Raise ``UnknownEnvironment`` if the simulator called ``name`` can't take steps of the declared period."""
        require_period(name, spec, self.period)

    @abstractmethod
    def close(self) -> None:
        """Release the simulator's resources."""

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the index into the state for each name.

        Raises:
            UnknownEnvironment: a name is not a variable of the simulator.
        """
        known = [variable.name for variable in self.variables]
        if unknown := [name for name in names if name not in known]:
            raise UnknownEnvironment(
                f"expected coordinates that are variables of the state, {known}, got {unknown}: correct the "
                "specification"
            )
        return [known.index(name) for name in names]

    def action_taken(self, action: Array) -> Array:
        """Return the action (F,) as the simulator receives it, rounded to the simulator's type of numbers."""
        return np.atleast_1d(np.asarray(native_action(self.action, action), dtype=np.float64))

    def place(self, columns: list[int], coordinates: Array) -> None:
        """Set the variables at the indices ``columns`` to coordinates (C,), and all other variables to their fixed
        values in the attribute ``rest``."""
        state = self.rest.copy()
        state[columns] = coordinates
        self.write(state)

    def with_specification(self, spec: EnvironmentSpec, *, shows_own: bool, step_limit: float) -> Simulated:
        """Make the original environment from this simulator and a specification.

        Args:
            spec: the specification.
            shows_own: whether the specification's observation is the simulator's own.
            step_limit: seconds that one step may take, for simulators with a process of their own.
        """
        del step_limit
        return Simulated(self, spec, shows_own=shows_own)


class Simulated:
    """An original environment made from a simulator and a specification, whose coordinates are variables of the state,
    by name. It can be set to given coordinates, and reset.

    Args:
        simulator: the simulator.
        spec: the specification.
        shows_own: whether the specification's observation is the simulator's own.
    """

    parallel = True

    def __init__(self, simulator: Simulator, spec: EnvironmentSpec, *, shows_own: bool = False) -> None:
        self.simulator = simulator
        self.shows_own = shows_own
        self._spec = spec
        self._columns = simulator.columns(spec.coordinate_names)
        able = {"any": simulator.settable, "snapshot": simulator.saves, "reset": True}
        if not able[spec.access]:
            raise UnknownEnvironment(
                f"{spec.environment} can't be set to a state, because its state can't be read: register it with "
                "--access reset, or give a specification with query 'rollout' and no snapshots"
            )

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Set the state to coordinates (C,), and apply an action (F,)."""
        self.place(coordinates)
        return self.act(action)

    def place(self, coordinates: Array) -> None:
        """Set the state to coordinates (C,)."""
        self.simulator.place(self._columns, coordinates)

    def begin(self, seed: int | None = None) -> Array:
        """Reset the simulator, and return the start coordinates (C,)."""
        self.simulator.reset(seed)
        return self.coordinates()

    def act(self, action: Array) -> RealStep:
        """Apply an action (F,) in the current state."""
        achieved = self.coordinates()
        taken = self.simulator.step(action)
        return RealStep(
            coordinates=achieved,
            action=self.simulator.action_taken(action),
            next_coordinates=self.coordinates(),
            reward=taken.reward,
            terminated=taken.terminated,
            truncated=taken.truncated,
            next_observation=taken.observation if self.shows_own else None,
        )

    def save(self) -> bytes:
        """Return the simulator's whole state as a snapshot. Raises ``StepFailed`` if the simulator can't return to a
        state."""
        return self.simulator.save()

    def restore(self, snapshot: bytes) -> Array:
        """Return to a saved state, and return its coordinates (C,)."""
        self.simulator.restore(snapshot)
        return self.coordinates()

    def coordinates(self) -> Array:
        """Return the simulator's current coordinates (C,)."""
        return wrapped(self._spec, self.simulator.read()[self._columns])

    def close(self) -> None:
        self.simulator.close()
