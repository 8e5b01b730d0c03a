"""A log as text: whoever sends it decides neither how much memory its columns take nor how long a message is."""

from __future__ import annotations

import pytest

from surrogym_shared.logs.table import UnusableLog, numbers
from surrogym_shared.logs.text import LONGEST_NAME, MOST_COLUMNS, table_of_text
from surrogym_shared.logs.writing import spreadsheet_cell


def test_one_long_cell_of_a_text_log_does_not_enlarge_its_column_in_memory() -> None:
    table = table_of_text("x,note\n" + "1,short\n" * 1_000 + f"2,{'long' * 10_000}\n", "the log")
    assert sum(column.nbytes for column in table.columns.values()) == 2 * 8 * len(table)
    assert numbers("x", table.columns["x"])[0].sum() == 1_002


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x\n1\n2\n3\n", "at most 2 rows in the log, got more"),
        (",".join(f"x{i}" for i in range(MOST_COLUMNS + 1)), f"at most {MOST_COLUMNS} columns in the log, got 1001"),
        ("x" * (LONGEST_NAME + 1), "names of at most 200 characters"),
        (f"x\n{'1' * 200_000}\n", "expected CSV in the log, got other text in line 2"),
    ],
)
def test_a_text_log_beyond_the_size_limits_is_refused(text: str, expected: str) -> None:
    with pytest.raises(UnusableLog, match=expected):
        table_of_text(text, "the log", most_rows=2)


@pytest.mark.parametrize(
    ("cell", "written"),
    [
        ("=1+1", "'=1+1"),
        ("\t@x", "'\t@x"),
        ("＋1", "'＋1"),
        ("\x1b[2J=", "\\x1b[2J="),
        ("-5.5", "-5.5"),
        ("+1e3", "+1e3"),
        (-5.5, -5.5),
        ("rig-7", "rig-7"),
    ],
)
def test_cells_of_an_exported_table_cannot_be_spreadsheet_formulas(cell: object, written: object) -> None:
    assert spreadsheet_cell(cell) == written
