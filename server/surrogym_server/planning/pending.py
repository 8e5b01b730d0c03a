"""Actions that are on their way: the state that a planner sees of a machine with a dead time.

The coordinates of such a machine repeat its latest actions (``surrogym_shared.spec.with_history``). If the last D
actions have no effect on the next step, whatever is chosen now acts D steps later. Until then the model predicts the
state, so a plan begins there, and each of its actions acts at once.

A dead time is seldom a whole number of steps. Then the action before still acts in a part of the step, and the state
alone does not say what an action leads to. The end of the step without the new action does: it follows from the end of
the step before and the action that was chosen then. So policies on a grid are functions of this end.

Shapes: N states, C coordinates, F action entries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from surrogym_server.models.abilities import ArraySteps
from surrogym_shared.spec import Action, BoxAction, DiscreteAction

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

POINTS = 512  # random states and actions at which effects of actions are compared
# An action of one age has an effect on a coordinate if it changes the next value by at least this share of what the
# action of the strongest age does.
EFFECT = 0.05
# Effects on a coordinate are compared with at least this share of the largest effect on any coordinate, so that
# rounding errors are none.
SLIGHT = 0.01


@dataclass(frozen=True, eq=False)
class PendingActions:
    """The actions that a machine has been given and that take effect later."""

    steps: ArraySteps
    dead: int  # number D of latest actions, the next one included, that have no effect on the next step
    late: bool  # whether an action still has an effect on the step after the first one that it has an effect on
    early: Ints  # (E, 2) index and action entry of each coordinate that takes a planned action, so that it acts at once
    neutral: Floats  # (F,) the action that stands for none: 0 or, if that is out of range, the nearest one

    @classmethod
    def of(cls, steps: ArraySteps) -> Self:
        """Return the pending actions of a model's steps."""
        repeated, action = steps.definition.repeated_actions, steps.definition.action
        felt = _felt(steps, repeated)
        dead = int(np.argmax(felt))
        early = np.ascontiguousarray(repeated[repeated[:, 2] <= dead, :2])
        neutral = np.clip(0.0, *np.array(action.ranges, dtype=np.float64).T)
        return cls(
            steps, dead, bool(felt[dead + 1 :].any()), early, neutral if isinstance(action, BoxAction) else 0 * neutral
        )

    def forecast(self, q: Floats, offsets: Floats) -> Floats:
        """Return the states (N, C) at which an action that is chosen at q (N, C) takes effect. ``offsets`` (N, C) are
        added to the predicted changes."""
        for _ in range(self.dead):
            q = self.after(q, np.tile(self.neutral, (len(q), 1)), offsets)
        return q

    def after(self, q: Floats, u: Floats, offsets: Floats) -> Floats:
        """Return the states (N, C) after one step."""
        found = self.steps(q, u, noise=None, process=None, paths=None, stds=False, reward_std=False).q_next
        return found if self.steps.definition.moves_observation else found + offsets

    def seen(self, q: Floats) -> Floats:
        """Return what a policy on a grid sees (N, C) at states q (N, C)."""
        none = np.zeros_like(q)
        q = self.forecast(q, none).copy()
        if not self.late:
            return q
        q[:, self.early[:, 0]] = self.neutral[self.early[:, 1]]
        return self.after(q, np.tile(self.neutral, (len(q), 1)), none)


def random_actions(action: Action, rng: np.random.Generator, count: int) -> Floats:
    """Return random actions (count, F). One discrete action is its number."""
    drawn = np.array([rng.uniform(*ends, count) for ends in action.ranges]).T
    return np.rint(drawn) if isinstance(action, DiscreteAction) else drawn


def _felt(steps: ArraySteps, repeated: Ints) -> NDArray[np.bool_]:
    """Return whether the action has an effect on the next step, and each earlier one up to the oldest that a coordinate
    repeats. At least one has."""
    oldest = int(repeated[:, 2].max(initial=0))
    if not oldest:
        return np.ones(1, dtype=np.bool_)
    low, high = (ends.cpu().numpy() for ends in steps.definition.sampled)
    rng, columns = np.random.default_rng(0), list(steps.definition.moving)
    q, other = (rng.uniform(low, high, (POINTS, len(low))) for _ in range(2))
    u, instead = (random_actions(steps.definition.action, rng, POINTS) for _ in range(2))
    if isinstance(steps.definition.action, DiscreteAction):
        for states in (q, other):
            states[:, repeated[:, 0]] = np.rint(states[:, repeated[:, 0]])

    def predicted(age: int) -> Floats:
        """Predict the states (POINTS, M) with another action of this age; of -1: of none."""
        changed, of_age = q.copy(), repeated[repeated[:, 2] == age, 0]
        changed[:, of_age] = other[:, of_age]
        acting = instead if age == 0 else u
        found = steps(changed, acting, noise=None, process=None, paths=None, stds=False, reward_std=False)
        return found.q_next[:, columns]

    unchanged = predicted(-1)
    # Change of each coordinate of the next state by another action of each age: root mean square, as a share of the
    # sampling range.
    span = (high - low)[columns]
    effect = np.array([np.sqrt(np.square((predicted(age) - unchanged) / span).mean(0)) for age in range(oldest + 1)])
    felt = np.asarray((effect >= EFFECT * effect.max(0).clip(SLIGHT * effect.max())).any(1))
    return felt if felt.any() else np.arange(oldest + 1) == 0
