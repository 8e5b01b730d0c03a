"""A session host: one process of the pool. It steps sessions for front servers, with models from the database."""

from __future__ import annotations

import asyncio
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any
from uuid import uuid4

import torch
from threadpoolctl import threadpool_limits

from surrogym_server import logs
from surrogym_server.convert import stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.engine.local import LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.sessions import MEBIBYTE, Limits
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import SurrogymError
from surrogym_server.features.ray.leases import Leases, Pace, seconds_now
from surrogym_server.features.ray.machine import machine_kind
from surrogym_server.features.ray.recorded import RecordedEngine, Surroundings
from surrogym_server.features.ray.store import LiveSessions
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.models import load_model, stored_tolerances
from surrogym_server.settings import Settings
from surrogym_server.storage.port import Storage
from surrogym_server.storage.sql import open_storage
from surrogym_shared.spec import EnvironmentSpec

OPERATIONS = frozenset(
    {
        "activity",
        "advance",
        "close",
        "coordinates",
        "describe",
        "forget",
        "open",
        "restore",
        "save",
        "submit",
        "sweep",
        "take",
    }
)


def versions() -> dict[str, str]:
    """Return the versions that all processes of a cluster must share, because they exchange pickled objects."""
    packages = ("surrogym", "torch", "numpy", "ray")
    return {"Python": platform.python_version(), **{name: version(name) for name in packages}}


@dataclass(frozen=True)
class HostSettings:
    """Settings that all hosts of a pool are started with.

    ``pool`` tells pools apart that use one database. The front server that starts the first host draws it. It is no
    setting of a user's, so it does not count when settings are compared.
    """

    hosts: int
    database: str = field(repr=False)  # it may hold a password
    limits: Limits
    max_lanes: int
    idle_seconds: float
    device: str
    threads: int
    pace: Pace
    pool: str = field(default_factory=lambda: uuid4().hex, compare=False)

    @classmethod
    def of(cls, settings: Settings) -> HostSettings:
        return cls(
            hosts=settings.ray_hosts,
            database=settings.database_url,
            limits=Limits(settings.max_sessions, settings.max_sessions_mib * MEBIBYTE, settings.max_waiting),
            max_lanes=settings.max_lanes,
            idle_seconds=settings.session_idle_seconds,
            device=settings.device,
            threads=settings.threads,
            pace=Pace(settings.ray_checkpoint_seconds, settings.ray_lease_seconds),
        )


@dataclass(frozen=True)
class Refused:
    """A refusal, returned as a value. If it were raised, Ray would wrap it in an exception of its own."""

    error: SurrogymError


@dataclass(frozen=True)
class HostInfo:
    """Settings of a running host, its versions and its machine."""

    settings: HostSettings
    versions: dict[str, str]
    machine: str
    node: str
    pid: int


class SessionHost:
    """Actor of Ray that steps sessions. It handles many requests at once, in one event loop.

    Args:
        settings: settings of the pool.
        number: number of this host, from 0. The ids of its sessions end with it.
    """

    def __init__(self, settings: HostSettings, number: int) -> None:
        logs.configure("info", "text")
        torch.set_num_threads(settings.threads)
        threadpool_limits(settings.threads, user_api="blas")
        self._settings = settings
        self._machine = machine_kind(settings.device, settings.threads)
        self._engine = recorded_engine(settings, open_storage(settings.database), number, self._machine)
        self._starting: asyncio.Task[None] | None = None

    async def about(self) -> HostInfo:
        """Describe this host, after it has started."""
        await self._started()
        return HostInfo(self._settings, versions(), self._machine, platform.node(), os.getpid())

    async def ping(self) -> None:
        """Return, which shows that this process runs."""

    async def ask(self, operation: str, *arguments: Any) -> Any:
        """Call a method of the engine, and return its reply, or ``Refused`` if the engine refused."""
        if operation not in OPERATIONS:
            raise ValueError(f"expected one of {sorted(OPERATIONS)}, got {operation!r}")
        await self._started()
        try:
            return await getattr(self._engine, operation)(*arguments)
        except SurrogymError as error:
            return Refused(error.with_traceback(None))

    async def counts(self) -> Any:
        """Return the counts of ``SessionEngine.counts`` for this host."""
        return self._engine.counts()

    async def _started(self) -> None:
        """Start the engine, if it has not started. Ray restarts a dead host without informing any front server."""
        if self._starting is None:
            self._starting = asyncio.create_task(self._engine.start())
        if not self._starting.done():
            await asyncio.shield(self._starting)


def recorded_engine(
    settings: HostSettings, storage: Storage, number: int, machine: str, clock: Callable[[], float] = seconds_now
) -> RecordedEngine:
    """Build the engine of one host.

    Args:
        settings: settings of the pool.
        storage: the database.
        number: number of the host.
        machine: kind of the machine, as ``machine_kind`` returns it.
        clock: returns seconds; leases end by it in this process.
    """
    definitions = Definitions(
        storage, lambda spec: stored_definition(read_stored(EnvironmentSpec, "a stored specification", spec))
    )
    models = ModelCache(
        lambda surrogate, version: load_model(storage, definitions, surrogate, version), storage.models.newest
    )
    inner = LocalEngine(
        models,
        lambda surrogate, version: stored_tolerances(storage, surrogate, version),
        limits=settings.limits,
        max_lanes=settings.max_lanes,
        idle_seconds=settings.idle_seconds,
        device=torch.device(settings.device),
        place=f".{number}",
    )

    def surrogate(id: int) -> tuple[str, EnvironmentDefinition]:
        record = storage.surrogates.get(storage.surrogates.name_of(id))
        return record.name, definitions.of(record)

    owner = f"{number} {settings.pool} {uuid4().hex}"
    live = storage.part(LiveSessions)
    leases = Leases(live, owner, machine, settings.pace, inner.end, clock)
    return RecordedEngine(inner, live, leases, Surroundings(surrogate, models.refresh))
