"""Cells: every combination once, resumed, several at once, ended together, and none lost that ended badly."""

import time
from collections import Counter
from dataclasses import replace

import pytest

from support.commands import parse
from support.metrics import METRICS
from support.studies import ignore, stand_in
from surrogym.demo.tasks import TASKS
from surrogym_lab.arms import ARMS
from surrogym_lab.commands import build
from surrogym_lab.reproduce.cells import Cell, cells, demo_command, done_already, run_cells, study
from surrogym_lab.reproduce.rows import Row, read_rows, row_of
from surrogym_lab.settings import StudySettings


def test_the_study_runs_every_combination_of_settings_ordered_by_seed():
    found = list(cells(["pendulum", "acrobot"], ["default", "paper"], range(3), shares=(1, 0.5), steps=8))
    assert len({cell.name for cell in found}) == len({cell.key for cell in found}) == 24
    assert [cell.settings.seed for cell in found] == [0] * 8 + [1] * 8 + [2] * 8
    assert {cell.key[2] for cell in found if cell.settings.task == "pendulum"} == {14, 7}


def test_a_study_run_is_a_valid_demo_command(tmp_path):
    (cell,) = cells(["acrobot"], ["no_loop"], [2], shares=(0.5,), steps=8, episodes=3)
    values = parse(demo_command(cell, tmp_path)[3:], build)
    names = ("task", "seed", "arm", "budget", "steps", "episodes", "pictures")
    assert [values[name] for name in names] == ["acrobot", 2, "no_loop", 50, 8, 3, False]


def test_a_result_row_marks_only_its_own_study_run_as_done():
    cell = Cell(StudySettings("pendulum", seed=1))
    row = Row("pendulum", "default", 1, 14, mean=-1.0, specification=cell.specification)
    assert done_already(cell, [row])
    for other in (
        replace(row, seed=2),
        replace(row, arm="paper"),
        replace(row, budget=7),
        replace(row, specification="of an older design"),
        replace(row, error="exit code 1"),
    ):
        assert not done_already(cell, [other])


def test_a_study_runs_the_default_on_every_task_and_variants_on_four():
    made = Counter((cell.settings.task, cell.settings.arm) for cell in study(list(TASKS), range(10)))
    assert {made[task, "default"] for task in TASKS} == {10}
    assert {task for task, arm in made if arm != "default"} == {"pendulum", "cartpole", "mountaincar", "swingup"}
    assert made["swingup", "latin_hypercube"] == made["pendulum", "paper"] == 10
    assert {made["swingup", arm] for arm in ARMS if ARMS[arm].access is None} == {5, 10}
    assert ("swingup", "snapshot") not in made, "it compares access, and the study compares designs"
    assert made["cartpole", "oracle"] == 5
    some = list(study(["acrobot", "pendulum"], range(3, 4), steps=9))
    assert {cell.settings.task for cell in some} == {"acrobot", "pendulum"}
    assert {(cell.settings.seed, cell.settings.steps) for cell in some} == {(3, 9)}


def test_the_hash_of_settings_does_not_depend_on_the_seed():
    plain = Cell(StudySettings("pendulum"))
    assert plain.specification == Cell(StudySettings("pendulum", seed=7, pictures=False)).specification
    changes = ({"arm": "variance"}, {"steps": 9}, {"budget": 7}, {"episodes": 3}, {"task": "cartpole"})
    assert len({plain.specification, *(Cell(StudySettings(**change)).specification for change in changes)}) == 6


def test_study_runs_are_parallel_and_a_failed_one_stops_no_other(tmp_path):
    todo = list(cells(["pendulum"], ["default"], range(4)))
    seen = []
    rows = run_cells(todo, [], tmp_path, 2, seen.append, stand_in(0.2, fails={1}))
    assert [row.seed for row in rows] == [0, 1, 2, 3]
    assert [row.error for row in rows] == ["", "exit code 1: error: no luck", "", ""]
    assert max(len(now.running) for now in seen) == 2
    assert [now.last.seed for now in seen if now.last is not None and now.last.error] == [1]
    assert seen[-1].done == seen[-1].of == 4
    assert any(now.left_seconds for now in seen)
    assert read_rows(tmp_path / "rows.csv") == rows
    left = [cell for cell in todo if not done_already(cell, rows)]
    assert [cell.settings.seed for cell in left] == [1]
    again = run_cells(left, rows, tmp_path, 1, ignore, stand_in())
    assert not any(row.error for row in again)


def test_an_interrupted_study_ends_its_runs_and_keeps_finished_results(tmp_path):
    def interrupt(now):
        if now.done == 1:
            raise KeyboardInterrupt

    todo = list(cells(["pendulum"], ["default"], range(3)))
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_cells(todo, [], tmp_path, 2, interrupt, lambda cell, run: stand_in(60.0 * cell.settings.seed)(cell, run))
    assert time.monotonic() - started < 20
    assert [row.seed for row in read_rows(tmp_path / "rows.csv")] == [0]


def test_a_study_keeps_earlier_result_rows(tmp_path):
    old = replace(row_of(METRICS), task="reacher")
    rows = run_cells(list(cells(["pendulum"], ["default"], [3])), [old], tmp_path, 1, ignore, stand_in())
    assert old in rows
    assert len(rows) == 2


def test_every_study_variant_has_its_own_colour():
    from surrogym_lab.reproduce.pictures import COLOURS

    assert set(COLOURS) == set(ARMS)
    assert len(set(COLOURS.values())) == len(ARMS)
