"""Evidence can be made again: cells resume, every seed counts, and the statistics are those they say they are."""

import json

import numpy as np
import pytest

from surrogym_client.reproduce.efficiency import Cell, bootstrap_interval, cells, markdown, run_cell, summaries

ROW = {
    "task": "pendulum",
    "arm": "default",
    "seed": 0,
    "initial": 4,
    "adaptive": 5,
    "real_steps": 9,
    "confidence_index": 1.0,
    "phase": "ready",
    "virtual_steps": 100,
    "mean": -150.0,
    "iqm": -140.0,
    "min": -400.0,
    "mean_length": 200.0,
    "success_rate": 1.0,
    "seconds": 50.0,
}


def test_every_combination_is_a_cell():
    found = list(cells(["pendulum", "acrobot"], ["default", "paper"], 3, ["--steps", "8"]))
    assert len({cell.name for cell in found}) == 12
    assert found[-1].arguments == ("acrobot", "--seed", "2", "--preset", "paper", "--steps", "8")
    assert found[0].configuration == found[1].configuration != found[3].configuration


def test_a_cell_that_is_done_is_read_not_run(tmp_path):
    cell = Cell("pendulum", "default", 0)
    row = {**ROW, "configuration": cell.configuration}
    (tmp_path / f"{cell.name}.json").write_text(json.dumps(row))
    assert run_cell(cell, tmp_path) == row
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{cell.name}.json"]


def test_no_seed_is_left_out_of_a_summary():
    rows = [
        {**ROW, "seed": i, "mean": m, "real_steps": 9 + i, "success_rate": s}
        for i, (m, s) in enumerate([(-150.0, 1.0), (-160.0, 0.9), (-1000.0, 0.2), (-155.0, 1.0)])
    ]
    (summary,) = summaries(rows)
    assert summary.seeds == 4
    assert summary.worst_seed == -1000.0
    assert summary.success == "20 %"
    assert summary.real_steps == "10.5 (9 to 12)"
    assert summary.real_return.startswith("-157.5 (")
    assert markdown([summary]).count("\n") == 3


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(60):
        low, high = bootstrap_interval(rng.normal(5.0, 2.0, 12))
        inside += low <= 5.0 <= high
    assert 48 <= inside <= 60


@pytest.mark.parametrize(
    ("option", "words"), [("--tasks=nothing", "unknown task 'nothing'"), ("--arms=x", "unknown arm 'x'")]
)
def test_what_is_not_known_is_refused(surrogym, option, words):
    said = surrogym("reproduce", "efficiency", option)
    assert said.code == 1
    assert words in said.err
