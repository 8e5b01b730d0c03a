"""Read a log from text: CSV with a heading."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.table import Table

DELIMITERS = ",;\t"
MOST_COLUMNS = 1_000
LONGEST_NAME = 200  # letters


def table_of_text(text: str, where: str, most_rows: int | None = None) -> Table:
    """Read a table from CSV whose cells are separated by commas, semicolons or tabs.

    Args:
        text: the log.
        where: source of the text, for messages.
        most_rows: largest number of rows; None for any number.

    Raises:
        UnusableLog: the text has no heading, two columns of the same name, or too many rows or columns.
    """
    heading = text.partition("\n")[0]
    delimiter = max(DELIMITERS, key=heading.count)
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    rows: list[list[str]] = []
    lines: list[int] = []
    faults: dict[int, str] = {}
    try:
        names = [name.strip() for name in next(reader, [])]
        _require_names(where, names)
        for row in reader:
            if not row:
                continue
            if len(rows) == most_rows:
                raise UnusableLog(f"expected at most {most_rows} rows in {where}, got more")
            if len(row) != len(names):
                faults[len(rows)] = f"expected {len(names)} columns, got {len(row)}"
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise UnusableLog(f"expected CSV in {where}, got other text in line {reader.line_num}: {error}") from error
    padded = [row if len(row) == len(names) else [*row, *([""] * len(names))][: len(names)] for row in rows]
    # An array of text of one width would be as wide as its longest cell, in every row.
    columns = {name: np.array([row[i] for row in padded], dtype=object) for i, name in enumerate(names)}
    return Table(columns, np.array(lines, dtype=np.int64), faults, rows, delimiter)


def _require_names(where: str, names: Sequence[str]) -> None:
    if not any(names):
        raise UnusableLog(f"expected a log with a heading that names its columns, got none in {where}")
    if len(names) > MOST_COLUMNS:
        raise UnusableLog(f"expected at most {MOST_COLUMNS} columns in {where}, got {len(names)}")
    if long := [name for name in names if len(name) > LONGEST_NAME]:
        raise UnusableLog(f"expected names of at most {LONGEST_NAME} letters in {where}, got {long[0][:40]!r}...")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UnusableLog(f"expected each column once in {where}, got {twice[0]!r} {names.count(twice[0])} times")
