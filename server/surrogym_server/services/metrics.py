"""Counters of the services of one server process since its start, for ``/metrics``.

The engine counts steps. Counts that outlive a process are computed from storage.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from surrogym_server.engine.tallies import Durations


@dataclass
class ProcessMetrics:
    """Counters that only grow. Written in the event loop's thread alone."""

    fits: Durations = field(default_factory=Durations)
    failed_fits: int = 0
    expired_leases: int = 0
    requests: dict[tuple[str, str, int], Durations] = field(default_factory=dict)  # by method, route, status
