"""Learning curves count what every seed has, and the table says who reached the target."""

import numpy as np
import pytest

from surrogym_lab.peers.curves import curve
from surrogym_lab.peers.pictures import draw_tasks
from surrogym_lab.peers.points import BUDGET, REACHED, TIME, Point, points_of
from surrogym_lab.peers.table import table, unfinished
from surrogym_lab.reproduce.rows import Row, UnusableRows, read_records, write_records


def rounds(seed, *pairs, ended=BUDGET, reached=False, method="sac"):
    made = [
        Point("pendulum", method, seed, i, steps, mean=mean, episodes=100, cpu_seconds=60.0)
        for i, (steps, mean) in enumerate(pairs, start=1)
    ]
    return [*made[:-1], Point(**{**vars(made[-1]), "ended": ended, "reached": reached})]


def test_a_learning_curve_keeps_the_last_return_of_each_seed():
    found = curve([*rounds(0, (10, -100.0), (30, -50.0)), *rounds(1, (20, -80.0))])
    assert found.steps.tolist() == [20, 30]  # from where both seeds have a policy
    assert found.middle.tolist() == [-90.0, -65.0]
    assert found.low is None


def test_a_learning_curve_of_three_seeds_has_an_interval():
    found = curve([point for seed in range(3) for point in rounds(seed, (10, -100.0 - seed), (20, -50.0))])
    assert found.low[0] < found.middle[0] < found.high[0]
    assert found.low[1] == found.high[1] == -50.0


def test_no_learning_curve_is_drawn_if_a_seed_has_no_result():
    assert curve([*rounds(0, (10, -100.0)), Point("pendulum", "sac", 1, 0, 0, ended="ValueError: no")]) is None


def test_the_comparison_table_counts_seeds_that_reached_the_target_and_failures():
    points = [
        *rounds(0, (1_000, -900.0), (2_000, -150.0), ended=REACHED, reached=True),
        *rounds(1, (1_000, -900.0), (5_000, -300.0), ended=TIME),
        Point("pendulum", "sac", 2, 0, 0, ended="ValueError: no"),
    ]
    (line,) = table(points).splitlines()[2:]
    assert (
        "| sac | 3 | 1 of 3 | 2,000; not reached by 2,500 (0 to 5,000); out of time; 1 failed: ValueError: no |" in line
    )
    assert "| -225.0 |" in line


def test_the_comparison_table_names_methods_and_seeds_not_finished():
    points = [Point("pendulum", "sac", 0, 1, 1_000, mean=-900.0)]
    assert "not reached by 1,000; 1 not finished" in table(points)
    assert unfinished([("pendulum", "sac", 0), ("pendulum", "sac", 1)], points) == ["pendulum sac (seeds 0, 1)"]


def test_result_rows_of_our_method_are_converted_to_curve_points():
    row = Row("pendulum", "default", 0, 14, 4, 3, 7, mean=-150.0, reached=True)
    half = Row("pendulum", "default", 0, 7, 4, 3, 7, mean=-400.0)
    first, second = points_of([row, half])
    assert (first.round, first.ended, second.round, second.ended) == (1, BUDGET, 2, REACHED)
    assert second.cell == ("pendulum", "default", 0)


def test_curve_points_are_read_back_from_their_file(tmp_path):
    points = rounds(0, (1_000, -900.0), (2_000, -150.5), ended=REACHED, reached=True)
    write_records(tmp_path / "points.csv", Point, points)
    assert read_records(tmp_path / "points.csv", Point) == points
    (tmp_path / "rows.csv").write_text("task,arm\n")
    with pytest.raises(UnusableRows, match="expected the columns task, method"):
        read_records(tmp_path / "rows.csv", Point)


def test_learning_curves_of_all_tasks_are_drawn_into_one_picture(tmp_path):
    points = [*rounds(0, (10, -100.0), (30, -50.0)), *rounds(0, (20, -80.0), method="ppo")]
    (picture,) = draw_tasks(tmp_path, points)
    assert picture.name == "peers.png"
    assert np.frombuffer(picture.read_bytes()[:4], np.uint8)[1:].tobytes() == b"PNG"
