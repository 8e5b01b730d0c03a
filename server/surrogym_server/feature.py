"""Interface between ``app.py`` and the optional features.

A feature is one folder of ``features``, with its routes, its service and the database tables that only it reads. It
imports other parts of the server, and only ``app.py`` imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from fastapi import APIRouter, Depends, Request
from prometheus_client import Metric

from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.port import Compute, SessionEngine
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import Complete
from surrogym_server.settings import Settings
from surrogym_server.storage.sql import Storage

S = TypeVar("S")


class Service:
    """Base class of an optional feature's service, of which a server process has one: periodic work and metrics."""

    async def sweep(self) -> None:
        """Do the periodic work of the feature. The server calls this after each interval of its setting
        ``sweep_seconds``."""

    def metrics(self) -> Iterable[Metric]:
        """Return the Prometheus metrics of the feature, which the endpoint ``/metrics`` shows."""
        return ()


@dataclass(frozen=True)
class Core:
    """Objects of the server process that an optional feature may use."""

    settings: Settings
    storage: Storage
    notices: Notices
    metrics: ProcessMetrics
    complete: Complete  # function that adds missing fields with their defaults to a specification (JSON)


@dataclass(frozen=True)
class Feature:
    """An optional feature: its routes, and the function that builds its service in a server process."""

    router: APIRouter
    start: Callable[[Core], Service]


@dataclass(frozen=True)
class Cluster:
    """A cluster of machines for sessions and fits, chosen by the setting ``engine``.

    Attributes:
        check: raises ``InvalidInput`` if this server can't use the cluster.
        connect: waits until the cluster is ready, and returns its engine.
        fits: returns the object that computes fits in the cluster; None if fits run in processes of this server.
    """

    check: Callable[[Settings], None]
    connect: Callable[[Settings, Storage], SessionEngine]
    fits: Callable[[Settings, Callable[[DesignJob], DesignResult]], Compute | None]


Parts = Mapping[type[Service], Service]  # the service of each optional feature, by the class of the service


def part(kind: type[S]) -> Any:
    """Return a FastAPI dependency whose value is the optional feature's service of class ``kind``."""

    async def started(request: Request) -> S:
        found = request.state.parts[kind]
        assert isinstance(found, kind)
        return found

    return Depends(started)
