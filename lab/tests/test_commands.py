"""Evidence by command: what is not known is refused, rows merge, and a page takes the table."""

import pytest

from surrogym_lab.reproduce.cells import Cell
from surrogym_lab.reproduce.rows import Row, read_rows, write_rows
from surrogym_lab.settings import StudySettings

ROW = Row("pendulum", "default", 0, 14, 4, 5, 9, mean=-150.0, min=-400.0, reached=True, seconds=1.0)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--tasks=nothing", "unknown task 'nothing': expected all, or some of pendulum, "),
        ("--arms=default,x", "unknown arm 'x': expected all, study, or some of default, "),
        ("--shares=half", "expected numbers separated by commas, got 'half'"),
        ("--shares=0", "expected numbers above 0"),
    ],
)
def test_unknown_tasks_and_variants_are_refused_by_the_efficiency_command(lab, option, words):
    said = lab("efficiency", option)
    assert said.code == 1
    assert words in said.err


def test_finished_runs_of_a_study_are_not_run_again(lab, tmp_path):
    row = Row(**{**vars(ROW), "specification": Cell(StudySettings("pendulum")).specification})
    write_rows(tmp_path / "out" / "rows.csv", [row])
    said = lab("efficiency", "--tasks=pendulum", "--seeds=1", "--out=out", "--json")
    assert said.code == 0
    assert "1 runs, 1 of them done already" in said.err
    assert [found["mean"] for found in said.json["rows"]] == [-150.0]


def test_the_trust_command_accepts_the_unseen_tasks(lab, tmp_path):
    made = Cell(StudySettings("kinetics", seed=7, pictures=False))
    row = Row(
        **{**vars(ROW), "task": "kinetics", "seed": 7, "budget": made.key[2], "specification": made.specification}
    )
    write_rows(tmp_path / "out" / "rows.csv", [row])
    said = lab("trust", "--tasks=kinetics", "--seeds=1", "--first-seed=7", "--out=out", "--json")
    assert said.code == 0
    assert "1 runs, 1 of them done already" in said.err
    assert "unknown task 'x': expected all, unseen, or some of" in lab("trust", "--tasks=x").err


def test_result_rows_of_several_sessions_are_merged_into_one_table(lab, tmp_path):
    write_rows(tmp_path / "night.csv", [ROW])
    oracle = Row("pendulum", "oracle", 0, 14, 0, 0, 300_000, mean=-170.0, min=-300.0, seconds=9.0)
    write_rows(tmp_path / "day.csv", [oracle])
    said = lab("table", "--rows=night.csv", "--rows=day.csv", "--out=both")
    assert said.code == 0
    assert read_rows(tmp_path / "both" / "efficiency.csv") == [ROW, oracle]
    assert (tmp_path / "both" / "efficiency.md").read_text() in said.out
    assert "| pendulum | oracle | 1 | 300,000 | -170.0 |" in said.out
    assert (
        lab("table", "--rows=nowhere.csv").err
        == "error: expected a file of rows, got nowhere.csv, which does not exist\n"
    )


def test_the_table_command_writes_the_table_into_a_page(lab, tmp_path):
    write_rows(tmp_path / "rows.csv", [ROW])
    (tmp_path / "page.md").write_text("<!-- efficiency: begin -->\n<!-- efficiency: end -->\n")
    assert lab("table", "--rows=rows.csv", "--out=.", "--page=page.md").code == 0
    assert "| pendulum | default |" in (tmp_path / "page.md").read_text()
    assert not (tmp_path / "efficiency.md").exists()
