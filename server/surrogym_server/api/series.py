"""Metrics of surrogates in the text format of Prometheus, without the Prometheus library, which takes 10 us for a
value."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from surrogym_server.storage.records import SurrogateSummary

Series = Iterable[tuple[str, float]]  # pairs of a label's value and the metric's value

PURPOSES = ("initial", "adaptive", "manual", "audit", "logged", "evaluation")
STATUSES = ("pending", "leased", "answered", "set_aside", "refused")


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
