"""A session host: one process of the pool. It reads models from the database, and is asked by front servers."""

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
from surrogym_server.cluster.leases import Leases, Pace, seconds_now
from surrogym_server.cluster.machine import machine_kind
from surrogym_server.cluster.recorded import RecordedEngine, Surroundings
from surrogym_server.convert import stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.engine.local import LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.sessions import MEBIBYTE, Limits
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import SurrogymError
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
    """What all processes of a cluster have to have in common: they send each other Python objects."""
    packages = ("surrogym", "torch", "numpy", "ray")
    return {"Python": platform.python_version(), **{name: version(name) for name in packages}}


@dataclass(frozen=True)
class HostSettings:
    """What the hosts of one pool are started with."""

    hosts: int
    database: str = field(repr=False)  # it may hold a password
    limits: Limits
    max_lanes: int
    idle_seconds: float
    device: str
    threads: int
    pace: Pace

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
    """An error that was raised on purpose, as a value: Ray would wrap it."""

    error: SurrogymError


@dataclass(frozen=True)
class HostInfo:
    """What a host was started with, and what it runs on."""

    settings: HostSettings
    versions: dict[str, str]
    machine: str
    node: str
    pid: int


class SessionHost:
    """An actor of Ray; it has one event loop, and many requests at once.

    Args:
        settings: of the pool.
        number: of this host, from 0. Its sessions have it in their ids.
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
        """Start, unless it has been done, and describe this host."""
        await self._started()
        return HostInfo(self._settings, versions(), self._machine, platform.node(), os.getpid())

    async def ping(self) -> None:
        """Return if this process runs."""

    async def ask(self, operation: str, *arguments: Any) -> Any:
        """Call a method of the engine; its reply, or ``Refused``."""
        if operation not in OPERATIONS:
            raise ValueError(f"expected one of {sorted(OPERATIONS)}, got {operation!r}")
        await self._started()
        try:
            return await getattr(self._engine, operation)(*arguments)
        except SurrogymError as error:
            return Refused(error.with_traceback(None))

    async def counts(self) -> Any:
        """As ``SessionEngine.counts``."""
        return self._engine.counts()

    async def _started(self) -> None:
        """Start once: Ray starts a host again after its death, and tells no front server."""
        if self._starting is None:
            self._starting = asyncio.create_task(self._engine.start())
        if not self._starting.done():
            await asyncio.shield(self._starting)


def recorded_engine(
    settings: HostSettings, storage: Storage, number: int, machine: str, clock: Callable[[], float] = seconds_now
) -> RecordedEngine:
    """The engine of one host.

    Args:
        settings: of the pool.
        storage: the database.
        number: of the host.
        machine: kind of the machine.
        clock: seconds, by which leases end here.
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

    leases = Leases(storage.live_sessions, f"{number} {uuid4().hex}", machine, settings.pace, inner.end, clock)
    return RecordedEngine(inner, storage.live_sessions, leases, Surroundings(surrogate, models.refresh))
