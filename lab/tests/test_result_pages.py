"""The pages of results show what their rows hold: tables are made from the CSV files beside them, and nothing else."""

from pathlib import Path

import pytest

from surrogym_lab.reproduce.page import present_sections, section
from surrogym_lab.reproduce.promises import promise_tables
from surrogym_lab.reproduce.rows import merge, read_rows
from surrogym_lab.reproduce.table import contrasts, grouped, summary, tasks_with_results

DOCS = Path(__file__).parents[2] / "docs"
ROWS = read_rows(DOCS / "results" / "efficiency.csv")


@pytest.mark.parametrize(
    ("page", "name", "rows", "out"),
    [
        ("results.md", "headline", "efficiency-audited", "runs/table"),
        ("results/efficiency.md", "efficiency", "efficiency", "docs/results"),
    ],
)
def test_the_tables_are_those_of_the_rows(page, name, rows, out):
    made = section(name, read_rows(DOCS / "results" / f"{rows}.csv"), ".")
    again = f"python -m surrogym_lab table --rows docs/results/{rows}.csv --out {out} --page docs/{page}"
    assert present_sections(DOCS / page) == {name: made}, again


@pytest.mark.parametrize(
    ("page", "name"),
    [
        ("older", "before"),
        ("older", "before-loop-end"),
        ("older", "before-prolonging"),
        ("older", "before-noise"),
        ("fresh-seeds", "fresh"),
        ("fastppo", "fastppo-default"),
        ("fastppo", "fastppo"),
        ("fastppo", "fastppo-mountaincar"),
        ("fastppo", "again"),
    ],
)
def test_tables_from_before_a_change_or_of_fresh_seeds_are_those_of_their_rows(page, name):
    rows = read_rows(DOCS / "results" / f"efficiency-{name}.csv")
    again = f"python -m surrogym_lab table --rows docs/results/efficiency-{name}.csv"
    text = (DOCS / "results" / f"{page}.md").read_text()
    assert summary(rows) in text, again
    assert contrasts(rows) in text, again


@pytest.mark.parametrize("study", ["trust", "trust-again", "trust-third", "trust-fourth", "trust-fifth", "trust-sixth"])
def test_every_table_of_the_unseen_tasks_is_that_of_its_rows(study):
    text, rows = (DOCS / "results" / f"{study}.md").read_text(), read_rows(DOCS / "results" / f"{study}.csv")
    made = summary(rows) + promise_tables(grouped(rows))
    tables = [line for line in made.splitlines() if line.startswith("|")]
    assert len(tables) > 30
    assert set(tables) <= set(text.splitlines())


def test_each_cell_has_one_row_and_each_task_its_picture():
    assert merge(ROWS) == ROWS
    assert all((DOCS / "results" / f"efficiency-{task}.png").exists() for task in tasks_with_results(ROWS))
