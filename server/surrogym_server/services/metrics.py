"""Counters of one server process since its start, for ``/metrics``.

Counts of steps are in the engine. Counts that survive a restart are read from the storage.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from surrogym_server.engine.tallies import Durations


@dataclass
class ProcessMetrics:
    """Counters of a server process, which only grow. Only the thread of the event loop changes them."""

    fits: Durations = field(default_factory=Durations)
    failed_fits: int = 0
    expired_leases: int = 0
    # Durations of HTTP requests, by (method, route, status code).
    requests: dict[tuple[str, str, int], Durations] = field(default_factory=dict)
