"""The settings of a sampler, what it needs to work, and the report of its run."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from surrogym_sampler.queries.snapshots import Bounds
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import QUERY_LEASE_SECONDS, Phase

Outcome = Literal["answered", "failed", "dropped", "refused", "impossible"]


def worker_name() -> str:
    """Return a name for this sampler, made of host and process id, that distinguishes it from others."""
    return f"{socket.gethostname()}-{os.getpid()}"[:128]


@dataclass(frozen=True)
class SamplerSettings:
    """Settings of a sampler.

    Attributes:
        name: name of the sampler; it is stored with each sample.
        batch: number of queries to claim at once; rollouts from resets are claimed one by one.
        wait_seconds: seconds that a claim waits for queries.
        lease_seconds: seconds for which a claimed query is reserved for this sampler.
        once: whether to stop after the first claim that returns queries.
        until_done: whether to stop when the design is ready or over its budget.
        max_queries: number of queries after which no further one begins.
        time_limit: seconds after which no further query begins.
        snapshots: folder that stores the surrogate's snapshots; None uses a temporary one.
        bounds: largest number and size of the snapshots.
    """

    name: str = field(default_factory=worker_name)
    batch: int = 4
    wait_seconds: float = 20.0
    lease_seconds: float = QUERY_LEASE_SECONDS
    once: bool = False
    until_done: bool = False
    max_queries: int | None = None
    time_limit: float | None = None
    snapshots: Path | None = None
    bounds: Bounds = field(default_factory=Bounds)


@dataclass(frozen=True)
class SamplerPlan:
    """What a sampler needs to work. The samplers of a cluster get it on their machines.

    Attributes:
        url: the server's address.
        token: the server's access token.
        surrogate: name of the surrogate.
        environment: name of the environment, such as a Gymnasium id or ``package.module:factory``; its modules must be
            importable on the machines.
        spec: a specification that replaces the environment's own; None keeps the own one.
        step_limit: seconds that one real step may take.
        settings: settings of the sampler.
        fallback: program of the fallback that the specification's limits name, as NAME=package.module:function.
        version: version of surrogym, which must be the same on all machines.
    """

    url: str
    token: str | None = field(repr=False)
    surrogate: str
    environment: str
    spec: EnvironmentSpec | None
    step_limit: float
    settings: SamplerSettings
    fallback: str | None = None
    version: str = field(default_factory=lambda: version("surrogym"))


@dataclass(frozen=True)
class SamplerReport:
    """The result of a sampler's run.

    Attributes:
        answered: number of queries answered with samples.
        failed: number of queries whose step failed.
        dropped: number of queries whose lease ended before a real step.
        refused: number of queries that the environment's own specification does not allow.
        impossible: number of queries whose snapshot can't be used.
        steps: number of real steps that were sent.
        seconds: duration of the run.
        phase: the design's last known phase; None if unknown.
        fallback_steps: number of real steps that the fallback controller of the declared limits took while no query
            ran; the ledger does not count them.
    """

    answered: int = 0
    failed: int = 0
    dropped: int = 0
    refused: int = 0
    impossible: int = 0
    steps: int = 0
    seconds: float = 0.0
    phase: Phase | None = None
    fallback_steps: int = 0
