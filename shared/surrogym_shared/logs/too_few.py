"""Error for a log with too few usable steps, with the most frequent reason why steps can't be used."""

from __future__ import annotations

import re
from collections import Counter

from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.table import Table
from surrogym_shared.logs.transitions import Transitions
from surrogym_shared.words import counted, has

DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d+,\d+\s*$")


class TooFewSteps(UnusableLog):
    """A log has too few usable steps. ``table`` is the log, and ``steps.rejected`` has the reason of each unusable
    row."""

    def __init__(self, message: str, table: Table, steps: Transitions) -> None:
        super().__init__(message)
        self.table = table
        self.steps = steps

    def __reduce__(self) -> tuple[type[TooFewSteps], tuple[str, Table, Transitions]]:
        return type(self), (str(self), self.table, self.steps)


def require_steps(table: Table, steps: Transitions, least: int) -> None:
    """Raise ``TooFewSteps`` with the most frequent reason if the log has fewer than ``least`` usable steps."""
    if len(steps) >= least:
        return
    minimum = "two usable steps" if least == 2 else "one usable step"
    parts = [f"expected {minimum} at least, got {len(steps)} of {counted(len(table), 'row')}"]
    if steps.ends:
        parts.append(
            f"{has(steps.ends, 'row')} no next state, because an episode or the log ends there, or a gap follows"
        )
    if steps.rejected:
        kinds = {row: _kind(reason) for row, reason in steps.rejected.items()}
        kind, count = Counter(kinds.values()).most_common(1)[0]
        row = next(row for row in kinds if kinds[row] == kind)
        parts.append(
            f"{counted(len(steps.rejected), 'row')} can't be used, {count} of them for the same reason, first in line "
            f"{table.lines[row]}: {steps.rejected[row]}"
        )
    if table.faults:
        parts.append(f"the columns are separated by {table.delimiter!r}: numbers need a decimal point, not a comma")
    elif any(DECIMAL_COMMA.match(cell) for row in steps.rejected for cell in table.row(row)):
        parts.append(
            f"the columns are separated by {table.delimiter!r}, and the numbers have a decimal comma: write a point"
        )
    raise TooFewSteps("; ".join(parts), table, steps)


def _kind(reason: str) -> str:
    """Return the reason of a rejected row without value and line number, so that faults of the same kind are equal."""
    return re.sub(r"line \d+", "line", reason.partition(", got")[0])
