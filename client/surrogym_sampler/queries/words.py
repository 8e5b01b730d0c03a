"""Descriptions of queries in lines of text: where a query begins and a bar for the size of each action, and the outcome
of a query."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surrogym_sampler.queries.settings import Outcome
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import Query, QueryView

BARS = "▁▂▃▄▅▆▇█"  # bars for the values of an action entry, from the lowest to the highest


@dataclass(frozen=True)
class Line:
    """A line of output about one answered or failed query."""

    text: str
    is_error: bool


def line_of(query: Query, outcome: Outcome, error: str) -> str:
    """Return a line of output about the outcome of a query; ``error`` is empty if there was none."""
    anew = " planned anew" if query.kind == "rollout" and query.replan else ""
    anew = " of a policy" if query.kind == "rollout" and query.policy else anew
    asked = f", {len(query.actions)} steps{anew}" if query.kind == "rollout" else ""
    return f"query {query.id} ({query.purpose}{asked}) {outcome}{': ' if error else ''}{error}"


def words_of_query(spec: EnvironmentSpec, query: Query | QueryView) -> list[str]:
    """Describe a query: its start, then one line for each entry of the action, with a bar for each step."""
    actions = query.actions if isinstance(query, QueryView) or query.kind == "rollout" else [query.action]
    steps = f"{len(actions)} step{'s' * (len(actions) > 1)}"
    how = "planned anew" if getattr(query, "replan", False) else "chosen by a policy"
    acts = getattr(query, "replan", False) or getattr(query, "policy", None)
    anew = f", each action {how} from the measured state; expected:" if acts else ""
    lines = [f"query {query.id} ({query.purpose}): {steps} from {_start(spec, query)}{anew}"]
    for entry, (low, high) in enumerate(spec.action.ranges):
        values = [action[entry] for action in actions]
        bars = "".join(BARS[min(int((v - low) / (high - low) * len(BARS)), len(BARS) - 1)] for v in values)
        lines.append(f"  action {entry} {bars} {_ends(values)} of {low:g} to {high:g}")
    return lines


def _start(spec: EnvironmentSpec, query: Query | QueryView) -> str:
    coordinates: Sequence[float] | None = getattr(query, "coordinates", None)
    if coordinates:
        return ", ".join(f"{name} {value:.4g}" for name, value in zip(spec.coordinate_names, coordinates, strict=True))
    snapshot: str | None = getattr(query, "snapshot", None)
    return f"the saved state {snapshot}" if snapshot else "a reset"


def _ends(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
