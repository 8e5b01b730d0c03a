"""A session host: a process of a Ray cluster that runs sessions for servers, with models from the database.

On machines of one kind, with the same versions of packages, a step gives the same bits.
"""

from __future__ import annotations

import asyncio
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any
from uuid import uuid4
from zlib import crc32

import torch
from threadpoolctl import threadpool_limits

from surrogym_server import logs
from surrogym_server.convert import stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.engine.local import MEBIBYTE, Limits, LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import SurrogymError
from surrogym_server.features.ray.leases import Leases, Pace, seconds_now
from surrogym_server.features.ray.recorded import RecordedEngine, Surroundings
from surrogym_server.features.ray.store import LiveSessions
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.models import load_model, stored_tolerances
from surrogym_server.settings import Settings
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.spec import EnvironmentSpec

PROCESSORS = Path("/proc/cpuinfo")
NAMES = ("model name", "flags", "Features")


def machine_kind(device: str, threads: int) -> str:
    """Describe processor, number of threads and device as one text, which is equal on machines that round equally.

    Args:
        device: "cpu" or "cuda".
        threads: number of threads of a torch operation.
    """
    parts = [platform.machine(), _processor(), f"threads {threads}"]
    return ", ".join([*parts, torch.cuda.get_device_name() if device == "cuda" else device])


def _processor() -> str:
    """Return the name of the first processor, and a hash of its instruction sets."""
    try:
        lines = PROCESSORS.read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    told = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    name, *abilities = (told.get(name, "") for name in NAMES)
    return f"{name} {crc32(' '.join(abilities).encode()):08x}"


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
    """Return the versions of Python and of packages, by name. They must be equal in all processes of a cluster, because
    these exchange pickled objects."""
    packages = ("surrogym", "torch", "numpy", "ray")
    return {"Python": platform.python_version(), **{name: version(name) for name in packages}}


@dataclass(frozen=True)
class HostSettings:
    """Settings of all session hosts of a pool.

    ``pool`` is a random id, which distinguishes several pools with one database. The server that starts the first host
    creates it. It is ignored when settings are compared.
    """

    hosts: int
    database: str = field(repr=False)  # the address may contain a password
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
    """An error that a session host returns as a value, because Ray would wrap a raised error in its own exception."""

    error: SurrogymError


@dataclass(frozen=True)
class HostInfo:
    """Description of a running session host: its settings, its versions of packages, and its machine."""

    settings: HostSettings
    versions: dict[str, str]
    machine: str
    node: str
    pid: int


class SessionHost:
    """Ray actor that runs sessions. It handles many requests at a time, in one event loop.

    Args:
        settings: settings of the pool of hosts.
        number: number of this host, from 0. The ids of the sessions that it opens end with this number.
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
        """Wait until this host has started, and return its description."""
        await self._started()
        return HostInfo(self._settings, versions(), self._machine, platform.node(), os.getpid())

    async def ping(self) -> None:
        """Return at once, to show that this process runs."""

    async def ask(self, operation: str, *arguments: Any) -> Any:
        """Call the method ``operation`` of the engine. Return its result, or ``Refused`` if it raised a
        ``SurrogymError``."""
        if operation not in OPERATIONS:
            raise ValueError(f"expected an operation of a session host, one of {sorted(OPERATIONS)}, got {operation!r}")
        await self._started()
        try:
            return await getattr(self._engine, operation)(*arguments)
        except SurrogymError as error:
            return Refused(error.with_traceback(None))

    async def counts(self) -> Any:
        """Return the counts of this host's engine."""
        return self._engine.counts()

    async def _started(self) -> None:
        """Start the engine if it has not started. This is needed after Ray has restarted a dead host."""
        if self._starting is None:
            self._starting = asyncio.create_task(self._engine.start())
        if not self._starting.done():
            await asyncio.shield(self._starting)


def recorded_engine(
    settings: HostSettings, storage: Storage, number: int, machine: str, clock: Callable[[], float] = seconds_now
) -> RecordedEngine:
    """Build the engine of a session host.

    Args:
        settings: settings of the pool of hosts.
        storage: storage of surrogates, models and session records.
        number: number of the host.
        machine: kind of the host's machine, as ``machine_kind`` returns it.
        clock: returns the time in seconds, by which leases end in this process.
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
