"""Types for a query and a real step, which the wire, the storage, the design and the sampler share.

They are plain values without checks, because the wire's models check all input. This file imports NumPy and the
standard library alone, so that the pure core may import it. Phases, verdicts and kinds are in ``states`` and ``kinds``.

Shapes: C coordinates, F action entries, D observation entries, T actions of a query, n real steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
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

    coordinates: Vector  # (C,) the C coordinates of the state to set; () for a query from a snapshot or a reset
    actions: tuple[Vector, ...]  # (T, F) actions of F entries to apply in T steps, one after the other
    snapshot: str | None = None  # name of the snapshot at which the steps begin; None: at coordinates or a reset
    # Whether each action is planned anew on the model, from the state that was measured. ``actions`` are then only
    # expected, and are applied where nothing can be planned.
    replan: bool = False
    # File of a policy (``Network.save``) that chooses each action from the measured state: the rollout is a trial.
    # ``actions`` are then those that the model expects, and the largest number of steps.
    policy: bytes | None = field(default=None, repr=False)

    @staticmethod
    def step(coordinates: Iterable[float], action: Iterable[float]) -> Query:
        """Return the query of one step from a state with coordinates (C,) under an action (F,)."""
        return Query(tuple(coordinates), (tuple(action),))

    @staticmethod
    def rollout(
        actions: Iterable[Iterable[float]],
        snapshot: str | None = None,
        *,
        replan: bool = False,
        policy: bytes | None = None,
    ) -> Query:
        """Return the query of T actions (T, F), one after the other, from a snapshot, or from a reset if it is None."""
        return Query((), tuple(map(tuple, actions)), snapshot, replan, policy)

    @property
    def kind(self) -> QueryKind:
        return "step" if self.coordinates else "rollout"

    @property
    def action(self) -> Vector:
        """The first action (F,), of F entries, which is the only action of a query of one step."""
        return self.actions[0]

    @property
    def steps(self) -> int:
        """Largest number of real steps in the answer to the query: its number of actions, T."""
        return len(self.actions)


@dataclass(frozen=True)
class RealStep:
    """One real step. ``coordinates`` and ``action`` are the achieved values, not the requested ones."""

    coordinates: ArrayLike  # (C,) the C coordinates of the state before the step
    action: ArrayLike  # (F,) applied action, with F entries
    next_coordinates: ArrayLike  # (C,) the C coordinates of the state after the step
    reward: float
    terminated: bool = False
    truncated: bool = False
    observation: ArrayLike | None = None  # (D,) observation of D entries before the step; None if not measured
    next_observation: ArrayLike | None = None  # (D,) observation of D entries after the step; None if not measured


@dataclass(frozen=True)
class RealSteps:
    """Real steps as arrays with a row for each step, in order of arrival: the samples from which a model is learned."""

    coordinates: NDArray[np.float64]  # (n, C) the C coordinates before each of n steps
    action: NDArray[np.float64]  # (n, F) action of F entries in each of n steps
    next_coordinates: NDArray[np.float64]  # (n, C) the C coordinates after each of n steps
    reward: NDArray[np.float64]  # (n,) reward of each of n steps
    terminated: NDArray[np.bool_]  # (n,) whether each of n steps ended the episode in a terminal state
    purpose: tuple[SamplePurpose, ...]  # purpose of each of n steps: why it was taken

    def __len__(self) -> int:
        return len(self.reward)

    @classmethod
    def of(cls, steps: Sequence[RealStep], purpose: SamplePurpose) -> Self:
        """Return the arrays of steps that were all taken for the same purpose."""
        return cls(
            coordinates=np.array([step.coordinates for step in steps], dtype=np.float64),
            action=np.array([step.action for step in steps], dtype=np.float64),
            next_coordinates=np.array([step.next_coordinates for step in steps], dtype=np.float64),
            reward=np.array([step.reward for step in steps], dtype=np.float64),
            terminated=np.array([step.terminated for step in steps], dtype=np.bool_),
            purpose=(purpose,) * len(steps),
        )
