"""How real episodes kept the limits of their specification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.limits import left_too_often, limits_of, past, room
from surrogym_shared.spec import EnvironmentSpec

# If a policy leaves the limits no more often than declared, they count as broken with at most this probability.
LEVEL = 0.05


@dataclass(frozen=True)
class LimitsKept:
    """How N real episodes kept the limits of their specification.

    Attributes:
        episodes: number of episodes.
        violations: number of episodes that left a limit.
        fallbacks: number of steps in which the fallback acted in the place of the policy.
        fallback_episodes: number of episodes with such a step.
        steps: number of all steps.
        least_room: by name of the limit, the smallest distance from an end of it; negative if the limit was left.
        probability: declared share of episodes that may leave a limit.
    """

    episodes: int
    violations: int
    fallbacks: int
    fallback_episodes: int
    steps: int
    least_room: dict[str, float]
    probability: float

    def interval(self) -> tuple[float, float]:
        """Return the exact 95 % interval (Clopper and Pearson) of the share of episodes that leave a limit."""
        from scipy.stats import binomtest  # imported on first use, because SciPy takes a second to load

        found = binomtest(self.violations, self.episodes).proportion_ci(method="exact")
        return float(found.low), float(found.high)

    @property
    def broken(self) -> bool:
        """Whether more episodes left a limit than the declared probability explains, at a level of 5 %."""
        return left_too_often(self.violations, self.episodes, self.probability, LEVEL)

    def summary(self) -> dict[str, Any]:
        """Return the counts and the interval, as JSON."""
        return {**asdict(self), "interval": list(self.interval())}

    def words(self) -> str:
        """Describe in a sentence how the limits were kept."""
        low, high = self.interval()
        return (
            f"{self.violations} of {self.episodes} episodes left a limit (95 % interval {100 * low:.2g} to "
            f"{100 * high:.2g} %, allowed {100 * self.probability:g} %); the fallback acted in {self.fallbacks} of "
            f"{self.steps} steps, in {self.fallback_episodes} of {self.episodes} episodes"
        )

    def expected(self, low: float, high: float) -> str:
        """Compare the share of episodes with a fallback with its predicted interval from ``low`` to ``high``, in words.
        The share differs if its exact 95 % interval lies outside of the predicted one."""
        from scipy.stats import binomtest

        real = binomtest(self.fallback_episodes, self.episodes).proportion_ci(method="exact")
        found = "more often" if real.low > high else "less often" if real.high < low else "as often"
        return (
            f"the fallback acted {found} {'as' if found == 'as often' else 'than'} expected: in {_percent(low, high)}"
        )


def _percent(low: float, high: float) -> str:
    return f"{100 * low:.2g} to {100 * high:.2g} % of the episodes"


def limits_kept(spec: EnvironmentSpec, paths: Sequence[NDArray[np.float64]], fallbacks: Sequence[int]) -> LimitsKept:
    """Count the episodes that left a limit.

    Args:
        spec: specification with limits.
        paths: states (T + 1, C) of each episode, at least one.
        fallbacks: number of steps of each episode in which the fallback acted.
    """
    least = np.min([room(spec, path).min(axis=0) for path in paths], axis=0)
    return LimitsKept(
        episodes=len(paths),
        violations=sum(bool(past(spec, path).any()) for path in paths),
        fallbacks=sum(fallbacks),
        fallback_episodes=sum(count > 0 for count in fallbacks),
        steps=sum(len(path) - 1 for path in paths),
        least_room=dict(zip((limit.name for limit in limits_of(spec).keep), least.tolist(), strict=True)),
        probability=limits_of(spec).probability,
    )
