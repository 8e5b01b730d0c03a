"""``GET /metrics``: counters and states of the server in the text format of Prometheus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

from fastapi import APIRouter, Request
from fastapi.responses import Response
from prometheus_client import CollectorRegistry
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from surrogym_server.api.auth import READ
from surrogym_server.api.door import DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.api.series import exposition
from surrogym_server.api.state import Services, Use
from surrogym_server.engine.tallies import Durations
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_shared.codes import Code

router = APIRouter(tags=["service"], route_class=DoorRoute)


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    dependencies=[READ],
    response_class=Response,
    responses={200: {"content": {"text/plain": {}}}, **documented(Code.UNAVAILABLE)},
)
def metrics(request: Request, use: Use) -> Response:
    """Return metrics for Prometheus.

    Requests, steps, fits, expired leases and expired sessions are counted since this process started. Samples, queries
    and fidelity come from the database.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Reading(request.app.version, use, request.app.state.metrics, request.state.parts.values()))
    text = generate_latest(registry) + exposition(use.storage.surrogates.summaries())
    return Response(text, media_type=CONTENT_TYPE_LATEST)


class _Measured(Protocol):
    """Service of an optional feature that has metrics."""

    def metrics(self) -> Iterable[Metric]: ...


class _Reading:
    """Prometheus collector for one request of ``/metrics``."""

    def __init__(self, version: str, use: Services, metrics: ProcessMetrics, parts: Iterable[_Measured]) -> None:
        self._version = version
        self._parts = parts
        self._use = use
        self._metrics = metrics

    def collect(self) -> Iterator[Metric]:
        yield InfoMetricFamily("surrogym_build", "Version of the server.", {"version": self._version})
        metrics, engine = self._metrics, self._use.engine.counts()
        yield _requests(metrics)
        yield _durations(
            "surrogym_step_seconds", "Duration of a request that steps a session, with its wait.", engine.steps
        )
        yield _durations("surrogym_fit_seconds", "Duration of a fit and its choice of queries.", metrics.fits)
        yield CounterMetricFamily("surrogym_lane_steps", "Virtual environment steps.", engine.lane_steps)
        yield CounterMetricFamily("surrogym_failed_fits", "Fits that failed.", metrics.failed_fits)
        yield CounterMetricFamily("surrogym_expired_leases", "Leases that expired unanswered.", metrics.expired_leases)
        yield CounterMetricFamily("surrogym_expired_sessions", "Sessions that expired idle.", engine.expired)
        yield GaugeMetricFamily("surrogym_sessions", "Open sessions.", sum(engine.sessions.values()))
        yield GaugeMetricFamily("surrogym_lanes", "Lanes of all open sessions.", engine.lanes)
        yield GaugeMetricFamily("surrogym_session_requests", "Requests running or waiting.", engine.requests)
        for part in self._parts:
            yield from part.metrics()


def _requests(metrics: ProcessMetrics) -> Metric:
    family = HistogramMetricFamily(
        "surrogym_request_seconds", "Of a request over HTTP.", labels=("method", "route", "status")
    )
    for (method, route, status), durations in sorted(metrics.requests.items()):
        family.add_metric([method, route, str(status)], list(durations.cumulative()), durations.sum)
    return family


def _durations(name: str, text: str, durations: Durations) -> Metric:
    return HistogramMetricFamily(name, text, buckets=list(durations.cumulative()), sum_value=durations.sum)
