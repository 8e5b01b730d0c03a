"""What model-based peers share: coordinates from observations, features of angles, controls in [-1, 1], and episodes.

Shapes: N states, C coordinates, D observation entries, A features, F action entries.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_lab.peers.port import NotApplicable, Real
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, MultiDiscreteAction, Term
from surrogym_shared.spec.actions import Action
from surrogym_trainer.policies.predict import PerEpisode

Control = Callable[[Array], Array]
"""Coordinates (N, C) to controls (N, F) in [-1, 1]."""


class States:
    """How a peer sees the states and actions of a specification."""

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.spec = spec
        self.angles = np.array([c.kind == "angle" for c in spec.coordinates])
        self._entries = [_entries(spec, name) for name in spec.coordinate_names]
        self._low, self._high, self._values = _controls(spec.action)

    @property
    def features(self) -> int:
        """Number A of features."""
        return len(self.angles) + int(self.angles.sum())

    @property
    def controls(self) -> int:
        return self.spec.action.size

    def coordinates(self, observations: NDArray[Any]) -> Array:
        """Read coordinates (N, C) from observations (N, D)."""
        columns = [
            np.arctan2(observations[:, i[1]], observations[:, i[0]]) if len(i) == 2 else observations[:, i[0]]
            for i in self._entries
        ]
        return np.stack(columns, 1).astype(np.float64)

    def featured(self, q: Array) -> Array:
        """Features (N, A): linear coordinates, then cosines, then sines of angles."""
        angles = q[:, self.angles]
        return np.concatenate([q[:, ~self.angles], np.cos(angles), np.sin(angles)], 1)

    def change(self, q: Array, reached: Array) -> Array:
        """Change (N, C) from q to the reached coordinates, of an angle by at most half a turn."""
        change = reached - q
        turned = (change + np.pi) % (2 * np.pi) - np.pi
        return np.where(self.angles, turned, change)

    def snapped(self, u: Array) -> Array:
        """The nearest controls (N, F) that the environment can apply."""
        u = np.clip(u, -1, 1)
        return u if self._values is None else 2 * np.round((u + 1) / 2 * self._values) / self._values - 1

    def native(self, u: Array) -> Array:
        """Actions (N, F) of the environment for controls (N, F)."""
        exact = self._low + (self.snapped(u) + 1) / 2 * (self._high - self._low)
        return exact if self._values is None else np.round(exact)


def _controls(action: Action) -> tuple[Array, Array, Array | None]:
    """Smallest and largest action (F,), and the largest number (F,) of a discrete one; None for a continuous one."""
    match action:
        case BoxAction(low=low, high=high):
            return np.array(low), np.array(high), None
        case DiscreteAction(n=n):
            most = np.array([n - 1.0])
        case MultiDiscreteAction(nvec=nvec):
            most = np.array(nvec) - 1.0
    return np.zeros(len(most)), most, most


def _entries(spec: EnvironmentSpec, name: str) -> tuple[int, ...]:
    """Places of the observation entries that tell a coordinate: its own, or those of its cosine and sine."""
    terms = [entry.term for entry in spec.observation]
    if (plain := Term.linear(**{name: 1.0})) in terms:
        return (terms.index(plain),)
    pair = (Term.cos(**{name: 1.0}), Term.sin(**{name: 1.0}))
    if all(term in terms for term in pair):
        return terms.index(pair[0]), terms.index(pair[1])
    raise NotApplicable(f"the observation does not show the coordinate {name!r}, which this peer has to know")


@dataclass(frozen=True)
class Transitions:
    """Real transitions: coordinates q (N, C), controls u (N, F) and reached coordinates (N, C)."""

    q: Array
    u: Array
    reached: Array

    @classmethod
    def joined(cls, parts: Sequence[Transitions]) -> Transitions:
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("q", "u", "reached")))

    def picked(self, at: NDArray[np.int64]) -> Transitions:
        return Transitions(self.q[at], self.u[at], self.reached[at])

    def __len__(self) -> int:
        return len(self.q)


def episode(real: Real, states: States, control: Control, decisions: int, repeat: int) -> Transitions:
    """Run one real episode, or less if it ends.

    Args:
        real: the environment.
        states: how to see it.
        control: chooses controls.
        decisions: the largest number of controls.
        repeat: real steps that each control is applied for. One transition spans them all.
    """
    at, found = real.reset().coordinates, list[tuple[Array, Array, Array]]()
    over = False
    while not over and len(found) < decisions:
        u = states.snapped(control(at[None]))
        began = at
        for _ in range(repeat):
            moment = real.step(states.native(u)[0])
            at, over = moment.coordinates, moment.terminated or moment.truncated
            if over:
                break
        found.append((began, u[0], at))
    return Transitions(*(np.stack(part) for part in zip(*found, strict=True)))


def random_control(states: States, rng: np.random.Generator) -> Control:
    """Controls that are uniform in [-1, 1]."""
    return lambda q: rng.uniform(-1, 1, (len(q), states.controls))


class Held(PerEpisode):
    """A controller for evaluations that holds each action for ``repeat`` steps."""

    def __init__(self, states: States, control: Control, repeat: int) -> None:
        self._states = states
        self._control = control
        self._repeat = repeat
        self._steps = Counter[int]()
        self._held: dict[int, Array] = {}

    def actions(self, episodes: Sequence[int], observations: NDArray[np.float32]) -> NDArray[Any]:
        due = [i for i, number in enumerate(episodes) if self._steps[number] % self._repeat == 0]
        if due:
            chosen = self._states.native(self._control(self._states.coordinates(observations[due])))
            self._held |= {episodes[i]: action for i, action in zip(due, chosen, strict=True)}
        self._steps.update(episodes)
        return np.stack([self._held[number] for number in episodes])
