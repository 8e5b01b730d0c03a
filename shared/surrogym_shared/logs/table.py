"""A log as it was read: named columns of cells that nobody has interpreted yet, and cells as numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Cells = NDArray[Any]  # (n,) numbers, or text

TRUE, FALSE = ("true", "t", "yes"), ("false", "f", "no")
MAX_MEASURED = 1e30  # the server takes no larger number


@dataclass(frozen=True)
class Table:
    """n rows.

    Attributes:
        columns: cells by name, (n,) each; text in a CSV file, numbers elsewhere.
        lines: where each row stands in its file, (n,): the line of a CSV file, else the number of the row from 1.
        faults: what is wrong with a row as a whole, by row.
        cells: the row as it stands in the file, where that is text.
        delimiter: between two cells of that text.
        ignored: arrays of the file that are no columns, with the reason.
    """

    columns: dict[str, Cells]
    lines: Ints
    faults: dict[int, str] = field(default_factory=dict)
    cells: Sequence[Sequence[str]] = ()
    delimiter: str = ""
    ignored: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.columns)

    def row(self, index: int) -> list[str]:
        """A row as text."""
        if len(self.cells):
            return list(self.cells[index])
        return [str(column[index]) for column in self.columns.values()]


def numbers(name: str, cells: Cells) -> tuple[Floats, dict[int, str]]:
    """Cells as numbers (n,), NaN where they are none, and the reason for each of those."""
    values = _plain(cells) if cells.dtype.kind in "biuf" else _parsed(cells)
    unusable = np.flatnonzero(~(np.abs(values) <= MAX_MEASURED))
    return values, {int(row): f"{name}: {_reason(cells[row], values[row])}" for row in unusable}


def times(name: str, cells: Cells) -> tuple[Floats, dict[int, str]]:
    """Times (n,) in seconds, or in the column's own unit: numbers, dates of NumPy, or text as ISO 8601 has it."""
    if cells.dtype.kind == "M":
        seconds = cells.astype("datetime64[ns]").astype(np.int64) / 1e9
        values = np.where(np.isnat(cells), np.nan, seconds)
        return values, {int(row): f"{name}: missing" for row in np.flatnonzero(np.isnat(cells))}
    values, faults = numbers(name, cells)
    if cells.dtype.kind not in "biuf":
        for row in list(faults):
            try:
                moment = datetime.fromisoformat(str(cells[row]).strip())
            except ValueError:
                continue
            values[row] = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
            del faults[row]
    return values, faults


def flags(name: str, cells: Cells) -> tuple[Bools, dict[int, str]]:
    """Yes or no (n,): 1 and 0, true and false; and the reason for each cell that is neither."""
    if cells.dtype.kind not in "biuf":
        words = {**dict.fromkeys(TRUE, "1"), **dict.fromkeys(FALSE, "0")}
        cells = np.array([words.get(str(cell).strip().lower(), str(cell)) for cell in cells], dtype=np.str_)
    values, faults = numbers(name, cells)
    for row in np.flatnonzero(np.isfinite(values) & (values != 0) & (values != 1)):
        faults[int(row)] = f"{name}: expected 0 or 1, got {values[row]:g}"
    return values == 1, faults


def groups(cells: Cells) -> Ints:
    """A number for each different cell (n,), in the order of first appearance; a row with an empty cell is alone."""
    codes: dict[str, int] = {}
    found = np.zeros(len(cells), dtype=np.int64)
    for row, cell in enumerate(cells):
        text = str(cell).strip()
        alone = text in ("", "nan", "None")
        found[row] = codes.setdefault(f"\0{row}" if alone else text, len(codes))
    return found


def _plain(cells: Cells) -> Floats:
    return cells.astype(np.float64)


def _parsed(cells: Cells) -> Floats:
    try:
        return cells.astype(np.float64)
    except ValueError:
        return np.array([_number(cell) for cell in cells], dtype=np.float64)


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return float("nan")


def _reason(cell: Any, value: float) -> str:
    text = str(cell).strip()
    if np.isinf(value):
        return f"expected a finite number, got {text}"
    if np.isfinite(value):
        return f"expected at most {MAX_MEASURED:g} in size, got {text}"
    if text == "" or cell is None:
        return "missing"
    if text.lower() in ("nan", "na", "n/a", "null", "none"):
        return f"not a number: {text}"
    return f"expected a number, got {text[:40]!r}"
