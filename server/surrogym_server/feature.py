"""What ``app.py`` needs of an optional feature, and what a feature gets of the core.

A feature is one folder of ``features``, with its routes, its service and its tables. It imports the core, and the core
does not import it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from fastapi import APIRouter, Depends, Request
from prometheus_client import Metric

from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.port import Compute, SessionEngine
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import Complete
from surrogym_server.settings import Settings
from surrogym_server.storage.port import Storage

S = TypeVar("S")


class Service(Protocol):
    """What a feature does in a server process, whoever calls its routes."""

    async def sweep(self) -> None:
        """Called at every sweep, every ``sweep_seconds``."""

    def metrics(self) -> Iterable[Metric]:
        """Series of the feature for ``/metrics``."""


@dataclass(frozen=True)
class Core:
    """Objects of the server process that a feature may use."""

    settings: Settings
    storage: Storage
    notices: Notices
    metrics: ProcessMetrics
    complete: Complete  # a specification, as JSON, with every field that this program knows


@dataclass(frozen=True)
class Feature:
    """Routes, and the service behind them, which ``start`` builds in a server process."""

    router: APIRouter
    start: Callable[[Core], Service]


@dataclass(frozen=True)
class Cluster:
    """Other machines, where sessions and fits run; the setting ``engine`` names it.

    ``check`` raises ``InvalidInput`` if this server can't use it. ``connect`` waits until it is ready, and returns its
    engine. ``fits`` is None where fits run in processes of this server.
    """

    check: Callable[[Settings], None]
    connect: Callable[[Settings, Storage], SessionEngine]
    fits: Callable[[Settings, Callable[[DesignJob], DesignResult]], Compute | None]


Parts = Mapping[type[Service], Service]  # of the features, by class


def part(kind: type[S]) -> Any:
    """A route's dependency on the service of its feature."""

    async def started(request: Request) -> S:
        found = request.state.parts[kind]
        assert isinstance(found, kind)
        return found

    return Depends(started)
