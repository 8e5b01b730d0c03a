"""Settings of a sampler, and what its run came to."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from surrogym_sampler.queries.snapshots import Bounds
from surrogym_shared.wire import LEASE_SECONDS, Phase

Outcome = Literal["answered", "failed", "dropped", "refused", "impossible"]


def worker_name() -> str:
    """Return a name that distinguishes this sampler from others in the ledger."""
    return f"{socket.gethostname()}-{os.getpid()}"[:128]


@dataclass(frozen=True)
class SamplerSettings:
    """Settings of a sampler.

    ``batch``: queries to claim at once. ``until_done``: stop when the design is ready or over its budget. ``once``:
    stop after the first claim that returns queries. ``max_queries`` and ``time_limit`` (seconds): begin no query beyond
    either of them. ``snapshots``: folder that keeps the surrogate's snapshots; None: they end with the sampler.
    ``bounds``: of their number and size.
    """

    name: str = field(default_factory=worker_name)
    batch: int = 4
    wait_seconds: float = 20.0
    lease_seconds: float = LEASE_SECONDS
    once: bool = False
    until_done: bool = False
    max_queries: int | None = None
    time_limit: float | None = None
    snapshots: Path | None = None
    bounds: Bounds = field(default_factory=Bounds)


@dataclass(frozen=True)
class SamplerReport:
    """Result of a sampler's run.

    ``dropped`` counts queries whose lease ended before a real step, ``refused`` those that the environment's own
    specification does not allow, ``impossible`` those whose snapshot can't be used. ``phase`` is the
    design's last known phase.
    """

    answered: int
    failed: int
    dropped: int
    refused: int
    impossible: int
    steps: int  # real steps that were sent
    seconds: float
    phase: Phase | None
