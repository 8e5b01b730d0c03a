"""What a model of the family ``selected`` says of the families that were compared, in words and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from surrogym_shared.spec import EnvironmentSpec

SELECTED = "selected"
HEADING = ("output", "family", "", "score", "better by", "standard error", "in 90 %", "won in a row")
Row = tuple[str | float | None, ...]


def compares(spec: EnvironmentSpec) -> bool:
    """Return whether a specification names the family that compares others."""
    choice = spec.design.model
    name = choice if choice is None or isinstance(choice, str) else choice.name
    return name is not None and name.casefold() == SELECTED


def selection_of(spec: EnvironmentSpec, description: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return what a model's description says of the comparison; None if its family compares none."""
    found: Mapping[str, Any] | None = description.get("selection") if compares(spec) else None
    return found


def said_of(selection: Mapping[str, Any]) -> str:
    """Return in words how families were compared, and what was not compared."""
    held = selection["held_out"]
    lines = []
    if held["pieces"]:
        horizons = " and ".join(map(str, held["horizons"])) + (" step" if held["horizons"] == [1] else " steps")
        what = "pieces of trajectories" if held["kind"] == "trajectories" else "single steps"
        times = "once" if held["folds"] == 1 else f"{held['folds']} times"
        lines.append(
            f"families compared on {held['pieces']} held-out {what}, predicted {horizons} ahead, each fitted {times} "
            "without them (score: log density in nats; higher is better):"
        )
    return "\n".join([*lines, *held["notes"]])


def rows_of(selection: Mapping[str, Any], outputs: Sequence[str]) -> list[Row]:
    """Return a row for each family that was compared on an output, as in ``HEADING``. Outputs that were not compared
    have one row, with the family that serves them."""
    found: list[Row] = []
    for name, serving, standings in zip(outputs, selection["serving"], selection["standings"], strict=True):
        if not standings:
            found.append((name, serving, "serves", None, None, None, None, None))
        for one in standings:
            mark = "serves" if one["family"] == serving else ""
            numbers = (one[field] for field in ("score", "better", "error", "coverage", "wins"))
            found.append((name, one["family"], mark, *numbers))
    return found
