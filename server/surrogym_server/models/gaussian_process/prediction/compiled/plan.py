"""Compiled code that plans one action: rollouts of the model under a policy on a grid and changes of its actions."""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_server.compiled.grid import GRID, interpolated, locate, policy_action
from surrogym_server.environment.compiled.limits import beyond
from surrogym_server.models.gaussian_process.prediction.compiled.regions import judge
from surrogym_server.models.gaussian_process.prediction.compiled.step import step
from surrogym_shared.compiled.jit import compiled, entry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

KEEP = -2.0  # in the changes of a discrete action: the action of the best plan so far, -1 being the policy's


@compiled
def predicted(
    numbers: Floats,
    places: Ints,
    outputs: int,
    prior_numbers: Floats,
    prior_places: Ints,
    prior_has_regions: bool,
    uses: Floats,
    q: Floats,
    u: Floats,
    known: Floats,
    q_next: Floats,
    reward: Floats,
    over: Bools,
) -> None:
    """Write the states (N, C) after a step from q (N, C) with u (N, F), the rewards (N,) and whether a declared end is
    reached (N,) to the last three arrays. ``plan`` explains the other arguments."""
    none, std, added = np.zeros((0, 0)), np.empty((len(q), outputs)), known
    if len(uses):
        added = np.empty((len(q), len(uses)))
        step(prior_numbers, prior_places, q, u, none, none, none, none, False, False, q_next, reward, std, over, added)
        if prior_has_regions:
            judge(prior_numbers, prior_places, q, q_next, u.shape[1], False, reward, std, over)
        for i in range(len(q)):
            added[i, len(uses) - 1] = reward[i]
            for c in range(len(uses)):
                added[i, c] = uses[c] * added[i, c] + (known[i, c] if len(known) else 0.0)
    step(numbers, places, q, u, none, none, none, added, False, False, q_next, reward, std, over, none)


@compiled
def end_without_action(
    numbers: Floats,
    places: Ints,
    outputs: int,
    prior_numbers: Floats,
    prior_places: Ints,
    prior_has_regions: bool,
    uses: Floats,
    q: Floats,
    known: Floats,
    early: Ints,
    choices: int,
    least: Floats,
    most: Floats,
    without: Floats,
    u: Floats,
    end: Floats,
) -> None:
    """Write the states (N, C) at the end of a step from q (N, C) without a new action to ``end``. ``without`` (N, C)
    and ``u`` (N, F) are overwritten; ``plan`` explains the other arguments."""
    for i in range(len(q)):
        without[i] = q[i]
        for f in range(u.shape[1]):
            u[i, f] = 0.0 if choices else min(max(0.0, least[f]), most[f])
        for e in range(len(early)):
            without[i, early[e, 0]] = u[i, early[e, 1]]
    reward, over = np.empty(len(q)), np.empty(len(q), np.bool_)
    predicted(
        numbers,
        places,
        outputs,
        prior_numbers,
        prior_places,
        prior_has_regions,
        uses,
        without,
        u,
        known,
        end,
        reward,
        over,
    )


@entry(
    types.float64[::1],
    types.int64[:, ::1],
    types.boolean,
    types.int64,
    types.float64[::1],
    types.int64[:, ::1],
    types.boolean,
    types.float64[::1],
    types.float64,
    *GRID,
    types.float64[::1],
    types.float64[:, ::1],
    types.float64,
    types.int64,
    types.float64[::1],
    types.float64[::1],
    types.float64[::1],
    types.int64[:, ::1],
    types.float64,
    types.float64[::1],
    types.float64[:, ::1],
    types.int64[:, ::1],
    types.boolean,
    types.float64[:, :, :, ::1],
    types.int64,
    types.float64[:, ::1],
    types.float64[::1],
    types.float64[::1],
)
def plan(
    numbers: Floats,
    places: Ints,
    has_regions: bool,
    outputs: int,
    prior_numbers: Floats,
    prior_places: Ints,
    prior_has_regions: bool,
    uses: Floats,
    terminal_reward: float,
    low: Floats,
    cell: Floats,
    count: Ints,
    cyclic: Bools,
    values: Floats,
    table: Floats,
    discount: float,
    choices: int,
    least: Floats,
    most: Floats,
    limit_numbers: Floats,
    limit_places: Ints,
    price: float,
    start: Floats,
    known: Floats,
    early: Ints,
    late: bool,
    changes: Floats,
    elite: int,
    best: Floats,
    action: Floats,
    arrival: Floats,
) -> float:
    """Search the changes of a policy's actions over T steps from one state, by R rounds of N rollouts. Return the
    return of the best rollout.

    In each rollout the policy acts on the state that the rollout has reached, so it also corrects the effect of earlier
    changes. Rewards after the last step are estimated by the values on the grid.

    Args:
        numbers, places, has_regions, outputs: the model, as in ``step.StepsOfModel``.
        prior_numbers, prior_places, prior_has_regions: the prior model.
        uses: (columns,) where its predictions are added, as in ``step.StepsOfModel``; (0,) without a prior model.
        terminal_reward: reward that steps that end the episode pay in addition.
        low, cell, count, cyclic: the grid, as in ``compiled.grid``.
        values: (S,) value of each node.
        table: (S, F) action of the policy at each node.
        discount: factor of later rewards.
        choices: number of discrete actions; 0 for continuous actions.
        least, most: (F,) smallest and largest action.
        limit_numbers, limit_places: tables of limits, as in ``environment.compiled.limits``; none if there are no
            places.
        price: cost of a step beyond limits, in addition to as much for each unit of the distance beyond them.
        start: (C,) state.
        known: (N, columns) numbers to add to the model's outputs at each step, or (0, 0), as in ``step.step``.
        early: (E, 2) index and action entry of the coordinates that take each step's action before the step.
        late: whether the policy and the values are functions of the end of a step without the new action.
        changes: (R, N, T, F) changes to try. Continuous ones are added to the mean of the ``elite`` best plans of the
            round before. A discrete one is an action, -1 for the policy's, or ``KEEP``. Rollout 0 of the first round
            follows the policy, rollout 1 the plan ``best``, whatever their changes are.
        elite: number of the best rollouts of a round whose mean the next round changes.
        best: (T, F) best plan of an earlier decision; becomes the best plan found.
        action: (F,) first action of the best rollout, written.
        arrival: (C,) state after its first step, written.
    """
    rounds, lanes, steps, size = changes.shape[0], changes.shape[1], changes.shape[2], len(start)
    entries = changes.shape[3]
    q, q_next, u = np.empty((lanes, size)), np.empty((lanes, size)), np.empty((lanes, entries))
    reward, std, over = np.empty(lanes), np.empty((lanes, outputs)), np.empty(lanes, np.bool_)
    running, total = np.empty(lanes, np.bool_), np.empty(lanes)
    plans, first, reached = np.empty((lanes, steps, entries)), np.empty((lanes, entries)), np.empty((lanes, size))
    nodes, weights, votes = np.empty(1 << len(low), np.int64), np.empty(1 << len(low)), np.empty(choices)
    without, seen = np.empty((lanes, size)), np.empty((lanes, size))
    centre, highest = best.copy(), -np.inf
    for k in range(rounds):
        for i in range(lanes):
            for t in range(steps):
                for f in range(entries):
                    change = changes[k, i, t, f]
                    if choices:
                        plans[i, t, f] = centre[t, f] if change == KEEP else change
                    else:
                        plans[i, t, f] = centre[t, f] + change
                    if k == 0 and i == 0:
                        plans[i, t, f] = -1.0 if choices else 0.0
                    elif i <= 1 and (k == 0 or i == 0):
                        plans[i, t, f] = centre[t, f]
            q[i], running[i], total[i] = start, True, 0.0
        weight = 1.0
        for t in range(steps + 1):
            if late:
                end_without_action(
                    numbers,
                    places,
                    outputs,
                    prior_numbers,
                    prior_places,
                    prior_has_regions,
                    uses,
                    q,
                    known,
                    early,
                    choices,
                    least,
                    most,
                    without,
                    u,
                    seen,
                )
            else:
                seen = q
            if t == steps:
                break
            for i in range(lanes):
                policy_action(low, cell, count, cyclic, table, choices, seen[i], nodes, weights, votes, u[i])
                for f in range(entries):
                    if choices and plans[i, t, f] >= 0:
                        u[i, f] = plans[i, t, f]
                    elif not choices:
                        u[i, f] = min(max(u[i, f] + plans[i, t, f], least[f]), most[f])
                for e in range(len(early)):
                    q[i, early[e, 0]] = u[i, early[e, 1]]
            predicted(
                numbers,
                places,
                outputs,
                prior_numbers,
                prior_places,
                prior_has_regions,
                uses,
                q,
                u,
                known,
                q_next,
                reward,
                over,
            )
            if has_regions:
                judge(numbers, places, q, q_next, entries, False, reward, std, over)
            if len(limit_places):
                far = beyond(limit_numbers, limit_places, q, q_next)
                for i in range(lanes):
                    if far[i] > 0:
                        reward[i] -= price * (1 + far[i])
            for i in range(lanes):
                if t == 0:
                    first[i], reached[i] = u[i], q_next[i]
                if running[i]:
                    total[i] += weight * (reward[i] + terminal_reward if over[i] else reward[i])
                    running[i] = not over[i]
            q, q_next = q_next, q
            weight *= discount
        for i in range(lanes):
            if running[i]:
                locate(low, cell, count, cyclic, seen[i], nodes, weights)
                total[i] += weight * interpolated(values, nodes, weights)
        order = np.argsort(-total)
        if total[order[0]] > highest:
            highest = total[order[0]]
            best[:], action[:], arrival[:] = plans[order[0]], first[order[0]], reached[order[0]]
        if choices:
            centre[:] = best
        else:
            centre[:] = 0.0
            for e in range(elite):
                centre += plans[order[e]] / elite
    return highest
