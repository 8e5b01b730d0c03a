"""The interface of an adapter to a simulator, and the original environment made from it with a specification."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from surrogym_sampler.original.errors import NotPerturbable, StepFailed, UnknownEnvironment
from surrogym_sampler.original.gymnasium import native_action, packed, unpacked, wrapped
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.actions import Action

SMALLEST_FACTOR = 0.05  # a mass or a length stays positive, however large the perturbation
Motion = Literal["slide", "turn", "speed", "held", "other"]


def random_factor(rng: np.random.Generator, sigma: float) -> float:
    """A factor around 1 for a mass or a length, with standard deviation ``sigma``."""
    return max(SMALLEST_FACTOR, 1.0 + sigma * float(rng.standard_normal()))


@dataclass(frozen=True)
class Variable:
    """One number of a simulator's state.

    ``motion``: ``slide`` along a line, ``turn`` about an axis, ``speed``, ``held`` through an episode (a goal, a
    setpoint), or ``other``. ``low`` and ``high`` are the simulator's own limits, None where it has none.
    """

    name: str
    motion: Motion = "other"
    low: float | None = None
    high: float | None = None
    driven: bool = False

    @property
    def limited(self) -> bool:
        return self.low is not None and self.high is not None


@dataclass(frozen=True)
class Taken:
    """Results of one step of a simulator; ``observation`` is its own, (D,)."""

    observation: Array
    reward: float
    terminated: bool
    truncated: bool


class Simulator(ABC):
    """One open simulator, after a first reset.

    Attributes:
        settable: whether its state can be written.
        fixed: why it can't, and what follows; a part of a sentence.
        shows: whether ``observe`` reads the state as it is, and not what the last step or reset gave.
        pays: whether steps have a reward; without one, the specification has to declare it.
        action: what can be done.
        variables: the state's numbers, (V,).
        rest: the state (V,) that a variable has where no coordinate says otherwise.
        time_limit: steps of an episode; None without a limit.
        period: seconds from one step to the next; None if it does not tell.
        scheduled: variables that a schedule sets, such as setpoints, with their lowest and highest value in it. They
            are coordinates, also where a few steps show one value alone.
        shown_limits: declared limits (D, 2) of the entries of its observation, infinite where it has none.
        notes: findings that a description repeats, one sentence each.
        questions: to a person who reads a description, one sentence each.
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
        """Whether it can return to a saved state."""
        return self.settable

    @abstractmethod
    def reset(self, seed: int | None) -> Array:
        """Begin an episode; the observation (D,)."""

    @abstractmethod
    def step(self, action: Array) -> Taken:
        """Apply action (F,)."""

    @abstractmethod
    def read(self) -> Array:
        """The state (V,)."""

    @abstractmethod
    def write(self, state: Array) -> None:
        """Set the state (V,) and forget everything else of earlier steps."""

    def save(self) -> Array:
        """All that decides what happens next, as numbers (K,): more than ``read`` where a solver remembers."""
        return self.read()

    def restore(self, saved: Array) -> None:
        """Return to what ``save`` gave, (K,)."""
        self.write(saved)

    @abstractmethod
    def observe(self) -> Array:
        """The observation (D,) of the state as it is, without a step."""

    def touches(self) -> bool:
        """Whether bodies touch in the state as it is; False where the simulator knows of none."""
        return False

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        """Multiply the original masses by normal factors of mean 1 and standard deviation ``sigma``.

        Raises:
            NotPerturbable: the simulator's masses are unknown.
        """
        del rng, sigma
        raise NotPerturbable(
            "only MuJoCo models, and classic control with its built-in specification, can be perturbed: write "
            "a changed class, and name it by --env"
        )

    @abstractmethod
    def close(self) -> None:
        """Release what the simulator holds."""

    def columns(self, names: Sequence[str]) -> list[int]:
        """Index into the state of each name.

        Raises:
            UnknownEnvironment: a name is no variable of the simulator.
        """
        known = [variable.name for variable in self.variables]
        if unknown := [name for name in names if name not in known]:
            raise UnknownEnvironment(f"coordinates {unknown} are not variables of the state: expected some of {known}")
        return [known.index(name) for name in names]

    def action_taken(self, action: Array) -> Array:
        """The action (F,) as the simulator gets it: rounded to its own numbers."""
        return np.atleast_1d(np.asarray(native_action(self.action, action), dtype=np.float64))

    def place(self, columns: list[int], coordinates: Array) -> None:
        """Set some variables to coordinates (C,), the others to rest."""
        state = self.rest.copy()
        state[columns] = coordinates
        self.write(state)

    def with_specification(self, spec: EnvironmentSpec, *, shows_own: bool, step_limit: float) -> Simulated:
        """The original environment made from this simulator. ``step_limit`` (s) is for simulators with a process of
        their own."""
        del step_limit
        return Simulated(self, spec, shows_own=shows_own)


class Simulated:
    """A simulator with a specification, whose coordinates are variables of the state by name. It can be set to given
    coordinates, and reset. ``shows_own``: whether the specification's observation is the simulator's own."""

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
        """Set the state to coordinates (C,), apply action (F,)."""
        self.place(coordinates)
        return self.act(action)

    def place(self, coordinates: Array) -> None:
        """Set the state to coordinates (C,)."""
        self.simulator.place(self._columns, coordinates)

    def begin(self, seed: int | None = None) -> Array:
        """Reset the simulator; the coordinates (C,) it starts at."""
        self.simulator.reset(seed)
        return self.coordinates()

    def act(self, action: Array) -> RealStep:
        """Apply action (F,) where the simulator stands."""
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
        """The simulator's whole state, bit for bit. Raises ``StepFailed`` if it can't return to a state."""
        if not self.simulator.saves:
            raise StepFailed("expected a simulator that can return to a saved state, got one that can only be reset")
        return packed(self.simulator.save())

    def restore(self, snapshot: bytes) -> Array:
        """Return to a saved state; its coordinates (C,)."""
        self.simulator.restore(unpacked(snapshot, self.simulator.save().shape))
        return self.coordinates()

    def coordinates(self) -> Array:
        """Present coordinates of the simulator, (C,)."""
        return wrapped(self._spec, self.simulator.read()[self._columns])

    def close(self) -> None:
        self.simulator.close()
