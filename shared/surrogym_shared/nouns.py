"""Types for a query and a real step, which the wire, the storage, the design and the sampler share.

They are plain values without checks, because the wire's models check all input. This file imports NumPy and the
standard library alone, so that the pure core may import it. Phases, verdicts and kinds are in ``states`` and ``kinds``.

Shapes: C coordinates, F action entries, D observation entries, T actions of a query, n real steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogym_shared.states import QueryKind, SamplePurpose

Vector = tuple[float, ...]


@dataclass(frozen=True)
class Query:
    """Request for real steps: where they begin, and the actions to apply from there.

    The steps begin at coordinates to which the original environment is set, at a snapshot to which it returns, or at a
    reset. A query that begins at coordinates has one action.
    """

    coordinates: Vector  # (C,) state to set; () for a query that begins at a snapshot or a reset
    actions: tuple[Vector, ...]  # (T, F) to apply, one after the other
    snapshot: str | None = None  # name of the snapshot to begin at

    @staticmethod
    def step(coordinates: Iterable[float], action: Iterable[float]) -> Query:
        """Return the query of one step from coordinates (C,) under an action (F,)."""
        return Query(tuple(coordinates), (tuple(action),))

    @staticmethod
    def rollout(actions: Iterable[Iterable[float]], snapshot: str | None = None) -> Query:
        """Return the query of an action sequence (T, F) from a snapshot, or from a reset."""
        return Query((), tuple(map(tuple, actions)), snapshot)

    @property
    def kind(self) -> QueryKind:
        return "step" if self.coordinates else "rollout"

    @property
    def action(self) -> Vector:
        """The first action (F,), which is the only one of a single step."""
        return self.actions[0]

    @property
    def steps(self) -> int:
        """Largest number of real steps of the answer, T."""
        return len(self.actions)


@dataclass(frozen=True)
class RealStep:
    """One real step. ``coordinates`` and ``action`` are the achieved values, not the requested ones."""

    coordinates: ArrayLike  # (C,) before the step
    action: ArrayLike  # (F,) that was applied
    next_coordinates: ArrayLike  # (C,) after the step
    reward: float
    terminated: bool = False
    truncated: bool = False
    observation: ArrayLike | None = None  # (D,) before the step, if it was measured
    next_observation: ArrayLike | None = None  # (D,) after the step, if it was measured


@dataclass(frozen=True)
class RealSteps:
    """Real steps as columns, in order of arrival: the samples from which a model is learned."""

    coordinates: NDArray[np.float64]  # (n, C) before each step
    action: NDArray[np.float64]  # (n, F) applied in each step
    next_coordinates: NDArray[np.float64]  # (n, C) after each step
    reward: NDArray[np.float64]  # (n,) of each step
    terminated: NDArray[np.bool_]  # (n,) whether each step ended the episode
    purpose: tuple[SamplePurpose, ...]  # (n,) why each step was taken

    def __len__(self) -> int:
        return len(self.reward)

    @classmethod
    def of(cls, steps: Sequence[RealStep], purpose: SamplePurpose) -> Self:
        """Return the columns of steps that were taken for one purpose."""
        return cls(
            coordinates=np.array([step.coordinates for step in steps], dtype=np.float64),
            action=np.array([step.action for step in steps], dtype=np.float64),
            next_coordinates=np.array([step.next_coordinates for step in steps], dtype=np.float64),
            reward=np.array([step.reward for step in steps], dtype=np.float64),
            terminated=np.array([step.terminated for step in steps], dtype=np.bool_),
            purpose=(purpose,) * len(steps),
        )
