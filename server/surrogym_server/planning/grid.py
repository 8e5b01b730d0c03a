"""Value iteration on a grid over the sampling range of a model."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.safety import LimitSet
from surrogym_server.models.abilities import ArrayTransition, Avoided, GridPolicy
from surrogym_server.planning.pending import PendingActions
from surrogym_shared.spec import MOST_PLANNED, MOST_PLANNED_ENTRIES, BoxAction, DiscreteAction, Limit

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

NODES = 100_000  # largest number of nodes of a grid
MOST_ALONG = 201  # largest number of nodes along one coordinate
LEVELS = {1: 5, 2: 3, 3: 3}  # number of values of each entry that value iteration tries, by the number of entries
FINE = 100  # smallest number of nodes along each coordinate of a grid on which the values begin at an upper bound
SWEEPS = 400  # largest number of sweeps of value iteration
SHIFTED = 20  # number of sweeps after which all values are moved by a constant, for a policy that keeps limits
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

    grid: tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]  # low, cell, count, cyclic, (K,) each
    actions: Floats  # (A, F)
    levels: Floats  # (F, L) values of each entry of a continuous action; (0, 0) for discrete ones
    q_next: Singles  # (S, A, K) state after the step; not a number where the episode ended
    reward: Singles  # (S, A) reward of the step
    # (S, A) how far the step leads beyond limits, as a share of the range of their terms; None without limits
    beyond: Singles | None = None

    @classmethod
    def of(
        cls, pending: PendingActions, terminal_reward: float, nodes: int = NODES, limits: LimitSet | None = None
    ) -> Self:
        """Predict the steps.

        Args:
            pending: the model's compiled steps, and what is known of actions that act later.
            terminal_reward: reward that steps that end the episode pay in addition.
            nodes: largest number of nodes.
            limits: limits that the actions are to keep.
        """
        action = pending.steps.definition.action
        assert isinstance(action, BoxAction | DiscreteAction)
        grid, (actions, levels) = _grid(pending.steps.definition, nodes), _actions(action)
        return cls(grid, actions, levels, *_transitions(pending, _nodes(*grid[:3]), actions, terminal_reward, limits))

    def policy(self, discount: float, reward: Singles | None = None, *, first: float = 0.0) -> GridPolicy:
        """Return the best policy by value iteration, for other rewards (S, A) than the model's if they are given.
        ``first`` is the value of each node before the first sweep."""
        paid = self.reward if reward is None else reward
        values = np.full(len(paid), first)
        self._settle(values, discount, paid)
        return self._greedy(values, discount, paid)

    def within(self, plain: GridPolicy, price: float) -> GridPolicy:
        """Return the best policy if each step beyond the limits costs ``price`` times 1 plus its distance beyond them.
        ``plain`` is the best policy without limits."""
        assert self.beyond is not None
        paid = np.where(self.beyond > 0, self.reward - price * (1 + self.beyond), self.reward).astype(np.float32)
        values, discount, least = plain.values.copy(), plain.discount, CHANGE * float(np.ptp(plain.values))
        for _ in range(SWEEPS // SHIFTED):
            if self._settle(values, discount, paid, SHIFTED, least):
                break
            # If the limits exclude where the plain policy stays, all values fall by about as much in each sweep, and
            # thousands of sweeps would be needed. A sweep uses values that it has changed, so they fall by up to twice
            # what the discount explains: hence the half.
            before = values.copy()
            self._settle(values, discount, paid, 2, least)
            values += 0.5 * np.median(values - before) / 2 / (1 - discount)
        return self._greedy(values, discount, paid)

    def _settle(
        self, values: Floats, discount: float, paid: Singles, sweeps: int = SWEEPS, least: float | None = None
    ) -> bool:
        """Update the values (S,) in place for rewards (S, A), until no value changes by more than ``least``, or than a
        share of their range. Return whether this was reached within a number of sweeps."""
        from surrogym_server.compiled.grid import sweep

        best = np.zeros(len(paid), dtype=np.int64)
        for number in range(sweeps):
            choosing = number % SWEEPS_PER_CHOICE == 0
            change = sweep(*self.grid, self.q_next, paid, discount, choosing, number % 2 == 0, values, best)
            if choosing and change <= (CHANGE * np.ptp(values) if least is None else least):
                return True
        return False

    def _greedy(self, values: Floats, discount: float, paid: Singles) -> GridPolicy:
        from surrogym_server.compiled.grid import choose

        table = np.empty((len(paid), self.actions.shape[1]))
        choose(*self.grid, self.q_next, paid, discount, values, self.levels, table)
        choices = 0 if len(self.levels) else len(self.actions)
        return GridPolicy(self.grid, values, table, discount, choices, self.actions.min(0), self.actions.max(0))


def solve(
    pending: PendingActions, terminal_reward: float, time_limit: int | None, limits: Sequence[Limit] = ()
) -> GridPolicy:
    """Return the policy with the highest return on a grid, and the limits that rollouts around it avoid.

    Args:
        pending: the model's compiled steps, and what is known of actions that act later.
        terminal_reward: reward that steps that end the episode pay in addition.
        time_limit: largest number of steps of an episode, if there is one.
        limits: limits that the policy keeps besides the declared ones. A step beyond them costs as much as the rewards
            of a whole episode can differ, and more with the distance, so no reward makes up for it. In rollouts, a step
            after which the declared fallback would act costs as much.
    """
    kept = LimitSet.of(limits, pending.steps.definition.coordinate_names) if limits else None
    on_grid, discount = GridModel.of(pending, terminal_reward, limits=kept), discount_of(time_limit)
    policy, declared = _solved(on_grid, discount), pending.steps.definition.limits
    every = [*limits, *(declared.keep if declared else ())]
    if not every:
        return policy
    least = on_grid.reward.min(where=~np.isnan(on_grid.q_next[:, :, 0]), initial=0.0)  # of steps that go on
    price = float(on_grid.reward.max() - least or 1.0) * (time_limit or LONGEST_EPISODE)
    policy = on_grid.within(policy, price) if limits else policy
    from surrogym_server.environment.compiled.limits import tables_of

    avoided = LimitSet.of(every, pending.steps.definition.coordinate_names)
    unit = _range_of(avoided, pending, _nodes(*on_grid.grid[:3]))
    # the fallback of declared limits also acts if one more step with the same change would lead within a margin
    ahead = torch.arange(len(every)) >= len(limits)
    return replace(policy, avoided=Avoided(*tables_of(avoided, unit, ahead), price))


def _solved(on_grid: GridModel, discount: float) -> GridPolicy:
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
    at = np.rint((q[:, : len(low)] - low) / cell).astype(np.int64)
    at = np.where(cyclic, at % count, at.clip(0, count - 1))
    actions: Floats = policy.table[(at * np.cumprod([1, *count[:-1]])).sum(1)]
    return actions


def unfit(definition: EnvironmentDefinition) -> str | None:
    """Return what a grid needs and the environment lacks, in words; None if nothing is missing."""
    action, coordinates = definition.action, definition.kept
    if coordinates > MOST_PLANNED:
        return f"at most {MOST_PLANNED} coordinates that repeat no action, got {coordinates}"
    if isinstance(action, DiscreteAction) or (isinstance(action, BoxAction) and action.size <= MOST_PLANNED_ENTRIES):
        return None
    return f"one discrete action, or at most {MOST_PLANNED_ENTRIES} continuous ones"


def _grid(definition: EnvironmentDefinition, nodes: int) -> tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Return low, cell, count and cyclic, (K,) each, of a grid over the sampling range of the K coordinates that repeat
    no action (see ``compiled.grid``), with at most so many nodes."""
    low, high = (ends[: definition.kept].cpu().numpy() for ends in definition.sampled)
    cyclic = np.array([c.kind == "angle" for c in definition.coordinates[: definition.kept]])
    along = min(int(nodes ** (1 / len(low))), MOST_ALONG)
    # An odd number of nodes has one in the middle of the range. The ends of an angle's range are the same node.
    count = np.where(cyclic, along, along - 1 + along % 2).astype(np.int64)
    return low.copy(), (high - low) / np.where(cyclic, count, count - 1), count, cyclic


def _nodes(low: Floats, cell: Floats, count: NDArray[np.int64]) -> Floats:
    """Return the states (S, K) of all nodes, the first coordinate running fastest."""
    axes = [a + b * np.arange(n) for a, b, n in zip(low, cell, count, strict=True)]
    return np.stack([axis.ravel(order="F") for axis in np.meshgrid(*axes, indexing="ij")], 1)


def _actions(action: BoxAction | DiscreteAction) -> tuple[Floats, Floats]:
    """Return the actions (A, F) that value iteration tries, and the levels (F, L) of each entry, none if the action is
    discrete."""
    if isinstance(action, DiscreteAction):
        return np.arange(action.n, dtype=np.float64)[:, None], np.zeros((0, 0))
    levels = np.linspace(action.low, action.high, LEVELS[action.size], axis=1)
    return np.array(list(itertools.product(*levels))), np.ascontiguousarray(levels)


def _range_of(limits: LimitSet, pending: PendingActions, nodes: Floats) -> Tensor:
    """Return the range of the term of each of L limits over the nodes (S, K) of a grid, (L,)."""
    lags = pending.steps.definition.repeated_actions
    past = np.tile(pending.neutral[lags[lags[:, 0] >= nodes.shape[1], 1]], (len(nodes), 1))
    values = limits.terms(torch.from_numpy(np.concatenate([nodes, past], 1)))
    return (values.amax(0) - values.amin(0)).clamp(min=1e-12)


def _transitions(
    pending: PendingActions, nodes: Floats, actions: Floats, terminal_reward: float, limits: LimitSet | None
) -> tuple[Singles, Singles, Singles | None]:
    """Return the states (S, A, K) after one step from each of the nodes (S, K) with each of the actions (A, F), its
    rewards (S, A), and how far it leads beyond ``limits`` (S, A), None without them. The states are not a number where
    the episode ended.

    At nodes within the margin of a declared limit, every action is that of the fallback, unless it is a program. A step
    after which the fallback would act costs as much as the rewards of two steps can differ.

    With late actions, both states are what ``PendingActions.seen`` returns: the end of a step without the action.
    """
    count, size, definition = len(actions), nodes.shape[1], pending.steps.definition
    q_next = np.empty((len(nodes), count, size), dtype=np.float32)
    reward = np.empty((len(nodes), count), dtype=np.float32)
    falling = np.empty((len(nodes), count), dtype=bool)
    beyond = None if limits is None else np.empty_like(reward)
    unit = None if limits is None else _range_of(limits, pending, nodes)
    repeated = definition.repeated_actions[definition.repeated_actions[:, 0] >= size]
    cyclic = [i for i, c in enumerate(definition.coordinates[:size]) if c.kind == "angle"]

    def step(q: Floats, u: Floats, past: Floats) -> ArrayTransition:
        """Predict the step from q (m, K) with the actions u (m, F) and, where those act late, ``past`` (m, F)."""
        acting = np.where(repeated[:, 2] <= pending.dead, u[:, repeated[:, 1]], past[:, repeated[:, 1]])
        whole = np.ascontiguousarray(np.concatenate([q, acting], 1))  # in the order of columns if q has one alone
        return pending.steps(whole, u, noise=None, process=None, paths=None, stds=False, reward_std=False)

    for begin in range(0, len(nodes), ROWS):
        q = np.repeat(nodes[begin : begin + ROWS], count, axis=0)
        none = np.tile(pending.neutral, (len(q), 1))
        whole = torch.from_numpy(np.concatenate([q, none[:, repeated[:, 1]]], 1))
        u = definition.with_fallback(whole, torch.from_numpy(np.tile(actions, (len(q) // count, 1)))).numpy()
        moved = step(q, u, none if pending.late else u)
        after = moved.q_next
        near = definition.falls_back(whole, torch.from_numpy(after)).numpy() & ~moved.terminated
        if pending.late:
            # The action moves the end of this step as it would move the end of a step from there.
            begun = q + after[:, :size] - step(q, none, none).q_next[:, :size]
            begun[:, cyclic] = (begun[:, cyclic] + np.pi) % (2 * np.pi) - np.pi
            after = step(begun, none, u).q_next
        arrived = np.where(moved.terminated[:, None], np.nan, after[:, :size])
        q_next[begin : begin + ROWS] = arrived.reshape(-1, count, size)
        reward[begin : begin + ROWS] = (moved.reward + terminal_reward * moved.terminated).reshape(-1, count)
        falling[begin : begin + ROWS] = near.reshape(-1, count)
        if limits is not None and beyond is not None and unit is not None:
            far = (limits.margin - limits.room(torch.from_numpy(after))) / unit
            beyond[begin : begin + ROWS] = far.amax(-1).clamp(min=0).numpy().reshape(-1, count)
    goes_on = ~np.isnan(q_next[:, :, 0])
    differ = reward.max(where=goes_on, initial=0.0) - reward.min(where=goes_on, initial=0.0)
    return q_next, np.where(falling, reward - differ, reward), beyond
