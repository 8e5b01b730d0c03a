"""Optimal trajectories of functions drawn from the posterior: samples of p(tau* | D), for acquisitions that read them.

A drawn function is a deterministic environment, so the best action sequence from a start is as good as the best policy.
It is searched for as plans of rollouts are: by random shooting, and by varying the best sequences. So a trajectory is
optimal as far as this search finds.

Reference: V. Mehta et al. (2022), ICLR, who search by model predictive control.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.step_rules import paid
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.forecast import DrawnFunctions
from surrogym_server.sampling.rollouts import Sequences, random_sequences, start_points, vary

POPULATION = 64  # action sequences compared at once, for each function
ELITE = 16  # of them that the next generation varies
GENERATIONS = 4


@dataclass(frozen=True)
class Executed:
    """N action sequences of T steps, each executed in one drawn function."""

    steps: PredictedSteps  # (N, T, ...)
    running: Tensor  # (N, T) bool, whether the episode runs before the step
    returns: Tensor  # (N,) sum of the rewards up to the end of the episode


def optimal_trajectories(
    model: DynamicsModel, count: int, horizon: int, rng: np.random.Generator
) -> tuple[PredictedSteps, ...]:
    """Draw functions, and find the trajectory with the highest return in each, from a start of its own.

    Returns:
        For each function the steps (T, ...) of its trajectory, T at most ``horizon`` and the time limit. Steps from
        which nothing can be learned, because lags are unknown, are left out.
    """
    definition = model.definition
    horizon = min(horizon, definition.time_limit or horizon)
    functions, starts = DrawnFunctions.of(model, count, rng), start_points(definition, count, rng)
    sequences = random_sequences(definition, count * POPULATION, horizon, rng).reshape(count, POPULATION, horizon, -1)
    each = torch.arange(count).repeat_interleave(POPULATION)
    for generation in range(GENERATIONS):
        flat = torch.from_numpy(sequences).flatten(0, 1)
        returns = execute(model, functions.rows(each), starts[each], flat).returns.reshape(count, POPULATION)
        if generation < GENERATIONS - 1:
            sequences = np.stack([_next(model, *pair, rng) for pair in zip(sequences, returns, strict=True)])
    best = torch.from_numpy(sequences)[torch.arange(count), returns.argmax(1)]
    done = execute(model, functions, starts, best)
    learned = done.running & definition.known(done.steps.q)
    return tuple(
        PredictedSteps(q[kept], u[kept], q_next[kept])
        for q, u, q_next, kept in zip(done.steps.q, done.steps.u, done.steps.q_next, learned, strict=True)
    )


def execute(model: DynamicsModel, functions: DrawnFunctions, starts: Tensor, actions: Tensor) -> Executed:
    """Execute actions (N, T, F) from starts (N, C), each row in its function."""
    q, running, returns = starts, torch.ones(len(starts), dtype=torch.bool), starts.new_zeros(len(starts))
    steps: list[tuple[Tensor, ...]] = []
    for u in actions.unbind(1):
        step = functions.step(q, u)
        over = model.terminated(step.q_next)
        returns = returns + running * paid(model.terminal_reward, step.reward, over)
        steps.append((q, u, step.q_next, running))
        q, running = step.q_next, running & ~over
    *taken, ran = (torch.stack(column, 1) for column in zip(*steps, strict=True))
    return Executed(PredictedSteps(*taken), ran, returns)


def _next(model: DynamicsModel, sequences: Sequences, returns: Tensor, rng: np.random.Generator) -> Sequences:
    """The next generation of one function's sequences (k, T, F): the best ones, and variations of them."""
    kept = returns.argsort(descending=True)[:ELITE].numpy()
    parents = np.concatenate([kept, kept[rng.integers(ELITE, size=POPULATION - ELITE)]])
    after: Sequences = sequences[parents]
    vary(model.definition, after[ELITE:], rng)
    return after
