"""The pages of results show what their rows hold: tables are made from the CSV files beside them, and nothing else."""

from pathlib import Path

import pytest

from surrogym_lab.reproduce.page import present_sections, section
from surrogym_lab.reproduce.promises import promise_tables
from surrogym_lab.reproduce.rows import merge, read_rows
from surrogym_lab.reproduce.table import contrasts, grouped, summary, tasks_with_results

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "lab" / "records" / "results"
ROWS = read_rows(RESULTS / "efficiency.csv")


@pytest.mark.parametrize(
    ("page", "name", "rows", "out"),
    [
        ("docs/evidence.md", "headline", "efficiency-audited", "runs/table"),
        ("lab/records/results/README.md", "headline", "efficiency-audited", "runs/table"),
        ("lab/records/results/efficiency.md", "efficiency", "efficiency", "lab/records/results"),
    ],
)
def test_the_tables_of_result_pages_equal_those_made_from_the_csv_rows(page, name, rows, out):
    made = section(name, read_rows(RESULTS / f"{rows}.csv"), ".")
    again = f"python -m surrogym_lab table --rows lab/records/results/{rows}.csv --out {out} --page {page}"
    assert present_sections(ROOT / page) == {name: made}, again


@pytest.mark.parametrize(
    ("page", "name"),
    [
        ("fresh-seeds", "fresh"),
        ("fastppo", "fastppo-default"),
        ("fastppo", "fastppo"),
        ("fastppo", "fastppo-mountaincar"),
        ("fastppo", "again"),
    ],
)
def test_the_tables_of_fresh_seeds_equal_those_made_from_their_csv_rows(page, name):
    rows = read_rows(RESULTS / f"efficiency-{name}.csv")
    again = f"python -m surrogym_lab table --rows lab/records/results/efficiency-{name}.csv"
    text = (RESULTS / f"{page}.md").read_text()
    assert summary(rows) in text, again
    assert contrasts(rows) in text, again


@pytest.mark.parametrize("study", ["trust", "trust-again", "trust-third", "trust-fourth", "trust-fifth", "trust-sixth"])
def test_the_tables_of_unseen_tasks_equal_those_made_from_their_csv_rows(study):
    text, rows = (RESULTS / f"{study}.md").read_text(), read_rows(RESULTS / f"{study}.csv")
    made = summary(rows) + promise_tables(grouped(rows))
    tables = [line for line in made.splitlines() if line.startswith("|")]
    assert len(tables) > 30
    assert set(tables) <= set(text.splitlines())


def test_each_recorded_run_has_one_row_and_each_task_a_picture():
    assert merge(ROWS) == ROWS
    assert all((RESULTS / f"efficiency-{task}.png").exists() for task in tasks_with_results(ROWS))
