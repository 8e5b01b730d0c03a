"""docs/results.md says what its rows say: the tables are made from the CSV file beside them, and from nothing else."""

from pathlib import Path

from surrogym_client.reproduce.page import present_section, section
from surrogym_client.reproduce.rows import merge, read_rows
from surrogym_client.reproduce.table import summary, tasks_with_results

DOCS = Path(__file__).parents[2] / "docs"
ROWS = read_rows(DOCS / "results" / "efficiency.csv")


def test_the_tables_are_those_of_the_rows():
    again = "surrogym reproduce table --rows docs/results/efficiency.csv --out docs/results --page docs/results.md"
    assert present_section(DOCS / "results.md") == section(ROWS, "results"), again


def test_the_table_from_before_mirror_images_is_that_of_its_rows():
    again = "surrogym reproduce table --rows docs/results/efficiency-before.csv"
    assert summary(read_rows(DOCS / "results" / "efficiency-before.csv")) in (DOCS / "results.md").read_text(), again


def test_each_cell_has_one_row_and_each_task_its_picture():
    assert merge(ROWS) == ROWS
    assert all((DOCS / "results" / f"efficiency-{task}.png").exists() for task in tasks_with_results(ROWS))
