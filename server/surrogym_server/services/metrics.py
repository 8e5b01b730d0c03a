"""What one server process has done since its start, for ``/metrics``. What lasts longer is counted in storage."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field

BUCKETS = (1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)


@dataclass
class Durations:
    """A histogram of seconds; observing costs a look into a table."""

    sum: float = 0.0
    _counts: list[int] = field(default_factory=lambda: [0] * (len(BUCKETS) + 1))

    def observe(self, seconds: float) -> None:
        self._counts[bisect_left(BUCKETS, seconds)] += 1
        self.sum += seconds

    def cumulative(self) -> Iterator[tuple[str, int]]:
        """(upper bound, how many lasted at most so long), the last bound infinite."""
        total = 0
        for bound, count in zip((*map(str, BUCKETS), "+Inf"), self._counts, strict=True):
            total += count
            yield bound, total

    def __len__(self) -> int:
        return sum(self._counts)


@dataclass
class ProcessMetrics:
    """Counters that only grow. Written in the event loop's thread alone."""

    steps: Durations = field(default_factory=Durations)  # requests that step, their waiting and computing included
    lane_steps: int = 0  # virtual environment steps
    fits: Durations = field(default_factory=Durations)
    failed_fits: int = 0
    expired_leases: int = 0
    expired_sessions: int = 0
    requests: dict[tuple[str, str, int], Durations] = field(default_factory=dict)  # by method, route, status
