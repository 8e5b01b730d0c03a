"""Value iteration on a grid over the sampling range of a model."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.abilities import ArraySteps, GridPolicy
from surrogym_shared.spec import MOST_PLANNED, BoxAction, DiscreteAction

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

NODES = 100_000  # largest number of nodes of a grid
MOST_ALONG = 201  # largest number of nodes along one coordinate
LEVELS = {1: 5, 2: 3, 3: 3}  # number of values of each entry that value iteration tries, by the number of entries
FINE = 100  # smallest number of nodes along each coordinate of a grid on which the values begin at an upper bound
SWEEPS = 400  # largest number of sweeps of value iteration
SWEEPS_PER_CHOICE = 5  # the best actions are chosen again in one of this number of sweeps
CHANGE = 1e-3  # value iteration stops once no value changes by more than this share of the range of the values
# one minus the discount, as a share of one step of an episode, so that an episode's last reward counts almost in full
DISCOUNTING = 0.04
LONGEST_EPISODE = 1_000  # number of steps of an episode that has no time limit
ROWS = 4_096  # number of steps that are predicted at once


@dataclass(frozen=True)
class GridModel:
    """Predicted steps from the S nodes of a grid over the sampling range, with each of A actions.

    ``compiled.grid`` explains grids.
    """

    grid: tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]  # low, cell, count, cyclic, (C,) each
    actions: Floats  # (A, F)
    levels: Floats  # (F, L) values of each entry of a continuous action; (0, 0) for discrete ones
    # (S, A, C) state after the step; not a number where the episode ended, or where the fallback of limits would act
    q_next: Singles
    reward: Singles  # (S, A) reward of the step

    @classmethod
    def of(cls, steps: ArraySteps, terminal_reward: float, nodes: int = NODES) -> Self:
        """Predict the steps.

        Args:
            steps: the model's compiled steps.
            terminal_reward: reward that steps that end the episode pay in addition.
            nodes: largest number of nodes.
        """
        action = steps.definition.action
        assert isinstance(action, BoxAction | DiscreteAction)
        grid, (actions, levels) = _grid(steps.definition, nodes), _actions(action)
        return cls(grid, actions, levels, *_transitions(steps, _nodes(*grid[:3]), actions, terminal_reward))

    def policy(self, discount: float, reward: Singles | None = None, *, first: float = 0.0) -> GridPolicy:
        """Return the best policy by value iteration, for other rewards (S, A) than the model's if they are given.
        ``first`` is the value of each node before the first sweep."""
        from surrogym_server.compiled.grid import choose, sweep

        paid = self.reward if reward is None else reward
        values, best = np.full(len(paid), first), np.zeros(len(paid), dtype=np.int64)
        for number in range(SWEEPS):
            choosing = number % SWEEPS_PER_CHOICE == 0
            change = sweep(*self.grid, self.q_next, paid, discount, choosing, number % 2 == 0, values, best)
            if choosing and change <= CHANGE * np.ptp(values):
                break
        table = np.empty((len(paid), self.actions.shape[1]))
        choose(*self.grid, self.q_next, paid, discount, values, self.levels, table)
        choices = 0 if len(self.levels) else len(self.actions)
        return GridPolicy(self.grid, values, table, discount, choices, self.actions.min(0), self.actions.max(0))


def solve(steps: ArraySteps, terminal_reward: float, time_limit: int | None) -> GridPolicy:
    """Return the policy with the highest return on a grid, for episodes of at most ``time_limit`` steps, if they have a
    limit. ``terminal_reward`` is what steps that end the episode pay in addition."""
    on_grid, discount = GridModel.of(steps, terminal_reward), discount_of(time_limit)
    if on_grid.grid[2].min() < FINE:
        return on_grid.policy(discount)
    # Thousands of sweeps would be needed to raise the values from 0 to those of an endless episode. Until then they
    # would depend on the order of the nodes. So they begin at an upper bound, or at 0 if all rewards are negative.
    highest = on_grid.reward.max(where=~np.isnan(on_grid.q_next[:, :, 0]), initial=0.0)
    return on_grid.policy(discount, first=float(highest) / (1 - discount))


def discount_of(time_limit: int | None) -> float:
    """Return the discount for episodes of at most ``time_limit`` steps, if they have a limit."""
    return 1 - DISCOUNTING / (time_limit or LONGEST_EPISODE)


def at_nearest_node(policy: GridPolicy, q: Floats) -> Floats:
    """Return the actions (s, F) of a policy at the node that is nearest to each state q (s, C)."""
    low, cell, count, cyclic = policy.grid
    at = np.rint((q - low) / cell).astype(np.int64)
    at = np.where(cyclic, at % count, at.clip(0, count - 1))
    actions: Floats = policy.table[(at * np.cumprod([1, *count[:-1]])).sum(1)]
    return actions


def unfit(definition: EnvironmentDefinition) -> str | None:
    """Return what a grid needs and the environment lacks, in words; None if nothing is missing."""
    action, coordinates = definition.action, len(definition.coordinates)
    if coordinates > MOST_PLANNED:
        return f"at most {MOST_PLANNED} coordinates, got {coordinates}"
    if isinstance(action, DiscreteAction) or (isinstance(action, BoxAction) and action.size in LEVELS):
        return None
    return "one discrete action, or at most three continuous ones"


def _grid(definition: EnvironmentDefinition, nodes: int) -> tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Return low, cell, count and cyclic, (C,) each, of a grid over the sampling range (see ``compiled.grid``), with at
    most so many nodes."""
    low, high = (ends.cpu().numpy() for ends in definition.sampled)
    cyclic = np.array([c.kind == "angle" for c in definition.coordinates])
    along = min(int(nodes ** (1 / len(low))), MOST_ALONG)
    # An odd number of nodes has one in the middle of the range. The ends of an angle's range are the same node.
    count = np.where(cyclic, along, along - 1 + along % 2).astype(np.int64)
    return low.copy(), (high - low) / np.where(cyclic, count, count - 1), count, cyclic


def _nodes(low: Floats, cell: Floats, count: NDArray[np.int64]) -> Floats:
    """Return the states (S, C) of all nodes, the first coordinate running fastest."""
    axes = [a + b * np.arange(n) for a, b, n in zip(low, cell, count, strict=True)]
    return np.stack([axis.ravel(order="F") for axis in np.meshgrid(*axes, indexing="ij")], 1)


def _actions(action: BoxAction | DiscreteAction) -> tuple[Floats, Floats]:
    """Return the actions (A, F) that value iteration tries, and the levels (F, L) of each entry, none if the action is
    discrete."""
    if isinstance(action, DiscreteAction):
        return np.arange(action.n, dtype=np.float64)[:, None], np.zeros((0, 0))
    levels = np.linspace(action.low, action.high, LEVELS[action.size], axis=1)
    return np.array(list(itertools.product(*levels))), np.ascontiguousarray(levels)


def _transitions(steps: ArraySteps, nodes: Floats, actions: Floats, terminal_reward: float) -> tuple[Singles, Singles]:
    """Return the states (S, A, C) after one step from each of the nodes (S, C) with each of the actions (A, F), and its
    rewards (S, A). The states are not a number where the episode ended.

    As in virtual episodes, an episode also ends where the fallback of declared limits would act, and gets the least
    reward, or 0 if that is less, for each missing step.
    """
    count, definition = len(actions), steps.definition
    q_next = np.empty((len(nodes), count, nodes.shape[1]), dtype=np.float32)
    reward = np.empty((len(nodes), count), dtype=np.float32)
    left = np.zeros((len(nodes), count), dtype=bool)
    for begin in range(0, len(nodes), ROWS):
        q = np.repeat(nodes[begin : begin + ROWS], count, axis=0)
        u = np.tile(actions, (len(q) // count, 1))
        moved = steps(q, u, noise=None, process=None, paths=None, stds=False, reward_std=False)
        over = definition.falls_back(torch.from_numpy(q), torch.from_numpy(moved.q_next)).numpy() & ~moved.terminated
        arrived = np.where((moved.terminated | over)[:, None], np.nan, moved.q_next)
        q_next[begin : begin + ROWS] = arrived.reshape(-1, count, nodes.shape[1])
        reward[begin : begin + ROWS] = (moved.reward + terminal_reward * moved.terminated).reshape(-1, count)
        left[begin : begin + ROWS] = over.reshape(-1, count)
    lost = reward.min(where=~left, initial=0.0) / (1 - discount_of(definition.time_limit))
    return q_next, np.where(left, np.float32(lost), reward)
