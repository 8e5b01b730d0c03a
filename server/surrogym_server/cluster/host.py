"""A session host: one process of the pool. It reads models from the database, and is asked by front servers."""

from __future__ import annotations

import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import torch
from threadpoolctl import threadpool_limits

from surrogym_server import logs
from surrogym_server.convert import stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.engine.local import LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.sessions import MEBIBYTE, Limits
from surrogym_server.errors import SurrogymError
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.models import load_model, stored_tolerances
from surrogym_server.settings import Settings
from surrogym_server.storage.sql import open_storage
from surrogym_shared.spec import EnvironmentSpec

OPERATIONS = frozenset(
    {"open", "advance", "describe", "coordinates", "submit", "close", "forget", "activity", "sweep", "save", "restore"}
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
        )


@dataclass(frozen=True)
class Refused:
    """An error that was raised on purpose, as a value: Ray would wrap it."""

    error: SurrogymError


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
        self._number = number
        self._storage = storage = open_storage(settings.database)
        definitions = Definitions(
            storage, lambda spec: stored_definition(read_stored(EnvironmentSpec, "a stored specification", spec))
        )
        self._engine = LocalEngine(
            ModelCache(
                lambda surrogate, version: load_model(storage, definitions, surrogate, version), storage.models.newest
            ),
            lambda surrogate, version: stored_tolerances(storage, surrogate, version),
            limits=settings.limits,
            max_lanes=settings.max_lanes,
            idle_seconds=settings.idle_seconds,
            device=torch.device(settings.device),
            place=f".{number}",
        )

    async def about(self) -> tuple[HostSettings, dict[str, str]]:
        """What this host was started with, and what it runs."""
        await self._engine.start()
        return self._settings, versions()

    async def ask(self, operation: str, *arguments: Any) -> Any:
        """Call a method of the engine; its reply, or ``Refused``."""
        if operation not in OPERATIONS:
            raise ValueError(f"expected one of {sorted(OPERATIONS)}, got {operation!r}")
        try:
            return await getattr(self._engine, operation)(*arguments)
        except SurrogymError as error:
            return Refused(error.with_traceback(None))

    async def counts(self) -> Any:
        """As ``SessionEngine.counts``."""
        return self._engine.counts()
