"""Settings of an algorithm that follow from a specification, or from other settings."""

from __future__ import annotations

from surrogym_shared.spec import EnvironmentSpec

BATCH = 1_024  # suggested size of a batch; large, because the time of an update depends mostly on the number of batches
SHORTEST_SIGHT, LONGEST_SIGHT = 0.9, 0.999  # smallest and largest suggested discount factor


def suggested_gamma(spec: EnvironmentSpec) -> float:
    """Return the discount factor whose horizon, 1 / (1 - gamma), is a third of the time limit: 0.985 for 200 steps,
    0.994 for 500."""
    return min(max(1 - 3 / (spec.time_limit or 1_000), SHORTEST_SIGHT), LONGEST_SIGHT)


def even_batch(rollout: int) -> int:
    """Return a batch size near 1,024 that divides the number of steps in a rollout; the whole rollout if it
    is smaller."""
    return next(rollout // k for k in range(max(rollout // BATCH, 1), rollout + 1) if rollout % k == 0)
