"""Value iteration on a grid over the sampling range of a model."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.abilities import ArraySteps, GridPolicy
from surrogym_shared.spec import BoxAction, DiscreteAction

Floats = NDArray[np.float64]

NODES = 100_000  # largest number of nodes of a grid
MOST_ALONG = 201  # largest number of nodes along one coordinate
LEVELS = {1: 5, 2: 3, 3: 3}  # number of values of each entry that value iteration tries, by the number of entries
SWEEPS = 400  # largest number of sweeps of value iteration
SWEEPS_PER_CHOICE = 5  # the best actions are chosen again in one of this number of sweeps
CHANGE = 1e-3  # value iteration stops once no value changes by more than this share of the range of the values
# one minus the discount, as a share of one step of an episode, so that an episode's last reward counts almost in full
DISCOUNTING = 0.04
ROWS = 4_096  # number of steps that are predicted at once


def solve(steps: ArraySteps, terminal_reward: float, time_limit: int) -> GridPolicy:
    """Compute the best policy on a grid by value iteration.

    Args:
        steps: the model's compiled steps.
        terminal_reward: reward that steps that end the episode pay in addition.
        time_limit: largest number of steps in an episode.
    """
    from surrogym_server.compiled.grid import choose, sweep

    definition = steps.definition
    grid = _grid(definition)
    action = definition.action
    assert isinstance(action, BoxAction | DiscreteAction)
    actions, levels = _actions(action)
    q_next, reward = _transitions(steps, _nodes(*grid[:3]), actions, terminal_reward)
    discount = 1 - DISCOUNTING / time_limit
    values, best = np.zeros(len(reward)), np.zeros(len(reward), dtype=np.int64)
    for number in range(SWEEPS):
        choosing = number % SWEEPS_PER_CHOICE == 0
        change = sweep(*grid, q_next, reward, discount, choosing, number % 2 == 0, values, best)
        if choosing and change <= CHANGE * np.ptp(values):
            break
    table = np.empty((len(reward), actions.shape[1]))
    choose(*grid, q_next, reward, discount, values, levels, table)
    choices = 0 if len(levels) else len(actions)
    return GridPolicy(grid, values, table, discount, choices, actions.min(0), actions.max(0))


def _grid(definition: EnvironmentDefinition) -> tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Return low, cell, count and cyclic, (C,) each, of a grid over the sampling range (see ``compiled.grid``)."""
    low, high = (ends.cpu().numpy() for ends in definition.sampled)
    cyclic = np.array([c.kind == "angle" for c in definition.coordinates])
    along = min(int(NODES ** (1 / len(low))), MOST_ALONG)
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


def _transitions(
    steps: ArraySteps, nodes: Floats, actions: Floats, terminal_reward: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the states (S, A, C) after one step from each of the nodes (S, C) with each of the actions (A, F), and its
    rewards (S, A). The states are not a number where the episode ended."""
    count = len(actions)
    q_next = np.empty((len(nodes), count, nodes.shape[1]), dtype=np.float32)
    reward = np.empty((len(nodes), count), dtype=np.float32)
    for begin in range(0, len(nodes), ROWS):
        q = np.repeat(nodes[begin : begin + ROWS], count, axis=0)
        u = np.tile(actions, (len(q) // count, 1))
        moved = steps(q, u, noise=None, process=None, paths=None, stds=False, reward_std=False)
        arrived = np.where(moved.terminated[:, None], np.nan, moved.q_next)
        q_next[begin : begin + ROWS] = arrived.reshape(-1, count, nodes.shape[1])
        reward[begin : begin + ROWS] = (moved.reward + terminal_reward * moved.terminated).reshape(-1, count)
    return q_next, reward
