"""Limits of the size of a log, which are checked before the cells of a file are converted."""

from __future__ import annotations

from surrogym_shared.logs.errors import UnusableLog

MOST_ROWS = 2_000_000
MOST_CELLS = 50_000_000
MOST_COLUMNS = 1_000
LONGEST_CELL = 10_000  # largest number of characters of a cell


def require_sizes(where: object, rows: int, cells: int) -> None:
    """Raise ``UnusableLog`` if the log from ``where`` has more rows or cells than allowed."""
    if rows > MOST_ROWS:
        raise UnusableLog(f"expected at most {MOST_ROWS:,} rows in {where}, got {rows:,}: import a part of the log")
    if cells > MOST_CELLS:
        raise UnusableLog(f"expected at most {MOST_CELLS:,} cells in {where}, got {cells:,}: import a part of the log")
