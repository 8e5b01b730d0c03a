"""Settings of an algorithm that follow from a specification, or from one another."""

from __future__ import annotations

from surrogym_shared.spec import EnvironmentSpec

BATCH = 1_024  # most of a training is the update, and its cost goes by the batch
SHORTEST_SIGHT, LONGEST_SIGHT = 0.9, 0.999  # discounts


def suggested_gamma(spec: EnvironmentSpec) -> float:
    """A discount whose horizon, 1 / (1 - gamma), is a third of the time limit: 0.985 for 200 steps, 0.994 for 500."""
    return min(max(1 - 3 / (spec.time_limit or 1_000), SHORTEST_SIGHT), LONGEST_SIGHT)


def even_batch(rollout: int) -> int:
    """Rows of a batch, about 1,024, of which a rollout is a whole number; the whole rollout where it is smaller."""
    return next(rollout // k for k in range(max(rollout // BATCH, 1), rollout + 1) if rollout % k == 0)
