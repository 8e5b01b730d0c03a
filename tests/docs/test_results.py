"""docs/results.md says what its rows say: the tables are made from the CSV file beside them, and from nothing else."""

from pathlib import Path

import pytest

from surrogym_client.experiments.reproduce.page import present_section, section
from surrogym_client.experiments.reproduce.rows import merge, read_rows
from surrogym_client.experiments.reproduce.table import contrasts, summary, tasks_with_results

DOCS = Path(__file__).parents[2] / "docs"
ROWS = read_rows(DOCS / "results" / "efficiency.csv")


def test_the_tables_are_those_of_the_rows():
    again = "surrogym reproduce table --rows docs/results/efficiency.csv --out docs/results --page docs/results.md"
    assert present_section(DOCS / "results.md") == section(ROWS, "results"), again


@pytest.mark.parametrize("name", ["before", "before-loop-end", "before-prolonging", "before-noise", "fresh"])
def test_tables_from_before_a_change_or_of_fresh_seeds_are_those_of_their_rows(name):
    rows = read_rows(DOCS / "results" / f"efficiency-{name}.csv")
    again = f"surrogym reproduce table --rows docs/results/efficiency-{name}.csv"
    assert summary(rows) in (DOCS / "results.md").read_text(), again
    assert contrasts(rows) in (DOCS / "results.md").read_text(), again


def test_each_cell_has_one_row_and_each_task_its_picture():
    assert merge(ROWS) == ROWS
    assert all((DOCS / "results" / f"efficiency-{task}.png").exists() for task in tasks_with_results(ROWS))
