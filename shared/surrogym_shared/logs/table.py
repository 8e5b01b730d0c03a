"""A log as it was read: named columns of cells, and functions that convert cells to numbers.

An error concerns the whole log. A fault of a single row is no error: the row is only left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.checks import MAX_MEASURED


class UnusableLog(ValueError):
    """A log, its mapping or its columns can't be used. The message says what was expected and what came."""


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Cells = NDArray[Any]  # (n,) cells of a column in n rows: numbers, or text

TRUE, FALSE = ("true", "t", "yes"), ("false", "f", "no")
NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
NO_FINITE = ("nan", "+nan", "-nan", "inf", "+inf", "-inf", "infinity", "+infinity", "-infinity")
BOOLEANS = {"True": 1.0, "False": 0.0, "true": 1.0, "false": 0.0, "TRUE": 1.0, "FALSE": 0.0}
DATES, DURATIONS = "M", "m"  # letters for the kinds of NumPy's types datetime64 and timedelta64 (``dtype.kind``)
NO_NUMBERS = {DATES: "dates", DURATIONS: "durations", "c": "complex numbers", "V": "records"}
FEWEST_STAMPS = 3  # a column with fewer numbers is not recognised as time stamps such as 20240331001500
MOST_STAMPS = 0.9  # a column has time stamps if more than this share of its numbers can be read as dates


@dataclass(frozen=True)
class Table:
    """A log of n rows.

    Attributes:
        columns: cells of each column (n,), by the column's name; text if the log is CSV, otherwise numbers.
        lines: line of each row in a CSV file, (n,); in other files the number of the row, from 1.
        faults: reason for each row that can't be used because of its form, by the row's index.
        cells: cells of each row as text, as in the file; empty if the log is not text.
        delimiter: character between two cells of the text.
        heading: names of the columns in the file, with empty and repeated ones; empty if the log is not text.
        unnamed: columns without a name in the file, by the names that they have in ``columns``.
        repeated: number of columns of each name that several columns have. Such columns are not in ``columns``.
        ignored: reason for each array of the file that is not a column, by its name.
        discrete: whether the file declares the action as discrete; None if it does not say.
        limits: lowest and highest value of action entries that the file declares, by the entry's name.
        remarks: sentences about the form of the file, for the report on the log.
        evaluated: whether the steps come from an evaluation in the surrogate's own environment, so that their units and
            ends are not in doubt.
    """

    columns: dict[str, Cells]
    lines: Ints
    faults: dict[int, str] = field(default_factory=dict)
    cells: Sequence[Sequence[str]] = ()
    delimiter: str = ""
    heading: tuple[str, ...] = ()
    unnamed: tuple[str, ...] = ()
    repeated: Mapping[str, int] = field(default_factory=dict)
    ignored: Mapping[str, str] = field(default_factory=dict)
    discrete: bool | None = None
    limits: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    evaluated: bool = False

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns that have a name, each name once."""
        return (*(name for name in self.columns if name not in self.unnamed), *self.repeated)

    def row(self, index: int) -> list[str]:
        """Return the cells of a row as text."""
        if len(self.cells):
            return list(self.cells[index])
        return [str(column[index]) for column in self.columns.values()]


def numbers(name: str, cells: Cells) -> tuple[Floats, dict[int, str]]:
    """Convert cells of the column ``name`` to numbers (n,), NaN for a cell that is not a number. Also return a reason
    for each such cell, by the row's index.

    Raises:
        UnusableLog: the whole column has dates, durations, complex numbers or records.
    """
    if kind := NO_NUMBERS.get(cells.dtype.kind):
        raise UnusableLog(f"{name}: expected a column of numbers, got {kind} ({cells.dtype})")
    values = cells.astype(np.float64) if cells.dtype.kind in "biuf" else _parse(cells)
    unusable = np.flatnonzero(~(np.abs(values) <= MAX_MEASURED))
    return values, {int(row): f"{name}: {_reason(cells[row], values[row])}" for row in unusable}


def times(name: str, cells: Cells) -> tuple[Floats, dict[int, str]]:
    """Convert cells of the column ``name`` to times (n,). Also return a reason for each cell that is no time, by the
    row's index.

    Dates and durations of NumPy and text in ISO 8601 become seconds. Numbers keep the column's own unit.
    """
    if cells.dtype.kind in (DATES, DURATIONS):
        fine = "datetime64[ns]" if cells.dtype.kind == DATES else "timedelta64[ns]"
        seconds = cells.astype(fine).astype(np.int64) / 1e9
        values = np.where(np.isnat(cells), np.nan, seconds)
        return values, {int(row): f"{name}: missing" for row in np.flatnonzero(np.isnat(cells))}
    values, faults = numbers(name, cells)
    if (dates := stamps(values)) is not None:
        odd = np.flatnonzero(np.isnan(dates) & np.isfinite(values))
        return dates, {**{int(row): f"{name}: expected a date, got {values[row]:.0f}" for row in odd}, **faults}
    if cells.dtype.kind not in "biuf":
        for row in list(faults):
            try:
                moment = datetime.fromisoformat(str(cells[row]).strip())
            except ValueError:
                continue
            values[row] = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
            del faults[row]
    return values, faults


def stamps(values: Floats) -> Floats | None:
    """Convert time stamps such as 20240331001500 to seconds (n,), NaN for a number that is no date.

    Numbers are time stamps if most of them are dates from 1900 to 2199, with or without a time of day. Return None for
    other numbers.
    """
    finite = np.where(np.isfinite(values), values, 0)
    # Divisors that leave the date of stamps which end with day, hour, minute or second.
    for below in (1, 100, 10_000, 1_000_000):
        day = np.floor(finite / below)
        if len(values) < FEWEST_STAMPS or not ((day >= 1900_01_01) & (day < 2200_00_00)).mean() > MOST_STAMPS:
            continue
        left = (finite - day * below) * (1_000_000 // below)
        hour, minute, second = left // 10_000, left // 100 % 100, left % 100
        months = ((day // 10_000 - 1970) * 12 + day // 100 % 100 - 1).astype(np.int64).astype("datetime64[M]")
        dates = months.astype("datetime64[D]") + (day % 100 - 1).astype(np.int64)
        same = (dates.astype("datetime64[M]") == months) & (day // 100 % 100 >= 1) & (day // 100 % 100 <= 12)
        valid = same & (hour < 24) & (minute < 60) & (second < 60)
        if valid.mean() > MOST_STAMPS:
            seconds = dates.astype(np.int64) * 86_400.0 + hour * 3_600 + minute * 60 + second
            return np.where(valid, seconds, np.nan)
    return None


def flags(name: str, cells: Cells) -> tuple[Bools, dict[int, str]]:
    """Convert cells such as 1, 0, true and false to booleans (n,). Also return a reason for each other cell, by the
    row's index."""
    if cells.dtype.kind not in "biuf":
        words = {**dict.fromkeys(TRUE, "1"), **dict.fromkeys(FALSE, "0")}
        cells = np.array([words.get(str(cell).strip().lower(), str(cell)) for cell in cells], dtype=np.str_)
    values, faults = numbers(name, cells)
    for row in np.flatnonzero(np.isfinite(values) & (values != 0) & (values != 1)):
        faults[int(row)] = f"{name}: expected 0 or 1, got {values[row]:g}"
    return values == 1, faults


def groups(cells: Cells) -> Ints:
    """Return a number for each cell (n,), equal for equal cells, in the order of their first appearance. Each empty
    cell has a number of its own."""
    codes: dict[str, int] = {}
    numbers = np.zeros(len(cells), dtype=np.int64)
    for row, cell in enumerate(cells):
        text = str(cell).strip()
        alone = text in ("", "nan", "None")
        numbers[row] = codes.setdefault(f"\0{row}" if alone else text, len(codes))
    return numbers


def is_number(cell: str) -> bool:
    """Whether text is a decimal number in ASCII digits, as CSV has it: no ``1_000`` and no digits of other scripts."""
    return NUMBER.fullmatch(cell.strip()) is not None


def is_date(cell: str) -> bool:
    """Whether text is a date in ISO 8601."""
    try:
        datetime.fromisoformat(cell.strip())
    except ValueError:
        return False
    return True


def _parse(cells: Cells) -> Floats:
    text = "".join(map(str, cells))
    if text.isascii() and "_" not in text:  # NumPy also reads 1_000 and digits of other scripts as numbers
        try:
            return cells.astype(np.float64)
        except ValueError:
            pass
    return np.array([_number(str(cell).strip()) for cell in cells], dtype=np.float64)


def _number(cell: str) -> float:
    if NUMBER.fullmatch(cell) or cell.lower() in NO_FINITE:
        return float(cell)
    return BOOLEANS.get(cell, float("nan"))


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
