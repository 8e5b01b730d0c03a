"""Compute a declared reward for the steps of a log that has no column of rewards."""

from __future__ import annotations

import numpy as np

from surrogym_shared.logs.table import Bools, Floats
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, RewardTerm
from surrogym_shared.terms import evaluate, holds


def declared_reward(spec: EnvironmentSpec, q: Floats, u: Floats, q_next: Floats, terminated: Bools) -> Floats:
    """Compute the declared rewards (n,) of n steps from states q (n, C) to ``q_next`` (n, C) under actions u (n, F).

    ``terminated`` (n,) says which steps end the episode. Raises ``TypeError`` if the reward is learned.
    """
    reward = spec.reward
    if not isinstance(reward, DeclaredReward):
        raise TypeError(f"expected a specification with a declared reward, got one with a {reward.kind} reward")
    read = q_next if reward.timing == "after" else q
    reward_sum = np.sum([_reward_of(spec, term, read, u) for term in reward.terms], axis=0)
    return np.asarray(reward_sum + reward.terminal * terminated, dtype=np.float64)


def _reward_of(spec: EnvironmentSpec, term: RewardTerm, q: Floats, u: Floats) -> Floats:
    """Compute one term (n,) of the reward for n steps: weight * shape(of) if all its inequalities hold, else 0."""
    of = [
        (0.0 if one.term is None else evaluate(spec, one.term, q)) + (u @ np.array(one.action) if one.action else 0.0)
        for one in term.of
    ]
    x = np.stack([np.broadcast_to(np.asarray(one), len(q)) for one in of]) if of else np.zeros((0, len(q)))
    match term.shape:
        case "one":
            shaped = np.ones(len(q))
        case "linear":
            shaped = x.sum(0)
        case "absolute":
            shaped = np.abs(x).sum(0)
        case "square":
            shaped = (x**2).sum(0)
        case "bump":
            shaped = np.exp(-0.5 * (x**2).sum(0))
        case "ball":
            shaped = ((x**2).sum(0) <= 1).astype(np.float64)
    paying = np.all([holds(spec, one, q) for one in term.when], axis=0) if term.when else np.ones(len(q), dtype=bool)
    return np.asarray(term.weight * shaped * paying, dtype=np.float64)
