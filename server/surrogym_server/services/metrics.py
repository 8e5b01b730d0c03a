"""What the services of one server process have done since its start, for ``/metrics``.

The engine counts steps; what lasts longer is counted in storage.
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
