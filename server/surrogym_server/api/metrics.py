"""``GET /metrics``: counters and states of the server in the text format of Prometheus.

The metrics of surrogates are written without the Prometheus library, which takes 10 us for a value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, get_args

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

from surrogym_server.api.door import READ, DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Services, Use
from surrogym_server.engine.tallies import Durations
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.storage.records import SurrogateSummary
from surrogym_shared.codes import Code
from surrogym_shared.states import PURPOSES, QueryStatus

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


Series = Iterable[tuple[str, float]]  # pairs of a label's value and the metric's value

STATUSES = get_args(QueryStatus)


@dataclass(frozen=True)
class Family:
    """A metric with its name, type and help text.

    ``label`` names the label by which the series of a surrogate differ; empty if there is at most one series.
    ``series`` returns pairs of a label's value and the metric's value for one surrogate.
    """

    name: str
    kind: str
    help: str
    label: str
    series: Callable[[SurrogateSummary], Series]


def exposition(summaries: Sequence[SurrogateSummary]) -> bytes:
    """Return the text of all metrics of these surrogates."""
    return "".join(line for family in FAMILIES for line in _lines(family, summaries)).encode()


def _lines(family: Family, summaries: Sequence[SurrogateSummary]) -> Iterator[str]:
    """Yield the lines of one metric. Names of surrogates need no escaping, because they consist of letters, digits,
    dots, dashes and underscores."""
    yield f"# HELP {family.name} {family.help}\n# TYPE {family.name} {family.kind}\n"
    for summary in summaries:
        begin = f'{family.name}{{surrogate="{summary.name}"'
        for label, number in family.series(summary):
            further = f',{family.label}="{label}"' if family.label else ""
            yield f"{begin}{further}}} {number}\n"


def _steps(summary: SurrogateSummary) -> Series:
    return [(purpose, getattr(summary.ledger, purpose)) for purpose in PURPOSES]


def _unresolved(summary: SurrogateSummary) -> Series:
    ledger = summary.ledger
    return (("failed", ledger.failed), ("expired", ledger.unresolved - ledger.failed))


def _queries(summary: SurrogateSummary) -> Series:
    return [(status, getattr(summary.queries, status)) for status in STATUSES]


def _one(number: float | None) -> Series:
    return () if number is None else (("", number),)


FAMILIES = (
    Family("surrogym_real_steps_total", "counter", "Acknowledged real steps by purpose.", "purpose", _steps),
    Family(
        "surrogym_unresolved_steps",
        "gauge",
        "Real steps that leases which ended without an answer may have taken.",
        "outcome",
        _unresolved,
    ),
    Family("surrogym_queries", "gauge", "Queries by status.", "status", _queries),
    Family("surrogym_phase", "gauge", "1 for the phase of a surrogate.", "phase", lambda of: ((of.phase, 1),)),
    Family(
        "surrogym_confidence_index",
        "gauge",
        "Of the latest model: the smallest over outputs.",
        "",
        lambda of: _one(of.confidence_index),
    ),
    Family("surrogym_model_version", "gauge", "The latest one.", "", lambda of: _one(of.model_version)),
)
