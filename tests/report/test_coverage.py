"""The picture of a log shows where it has been, and says where it has not."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_trainer.coverage import CELLS, columns_shown, coverage_of
from surrogym_trainer.figures import draw_coverage


def steps(speeds: tuple[float, float], rows: int = 4_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    q = np.stack([rng.uniform(-np.pi, np.pi, rows), rng.uniform(*speeds, rows)], axis=1)
    return q, rng.uniform(-2, 2, (rows, 1))


def test_the_coverage_map_of_a_log_over_the_whole_range_is_full() -> None:
    coverage = coverage_of(pendulum(), *steps((-8, 8)))
    assert {pair: coverage.share(pair) for pair in coverage.counts} == {(0, 1): 1.0, (0, 2): 1.0, (1, 2): 1.0}
    assert all(int(counts.sum()) == 4_000 for counts in coverage.counts.values())


def test_the_coverage_map_of_a_log_of_slow_speeds_is_empty_at_fast_speeds() -> None:
    coverage = coverage_of(pendulum(), *steps((-1.6, 1.6)))
    assert coverage.share((0, 1)) == pytest.approx(2 / CELLS)
    assert coverage.share((0, 2)) == 1.0
    assert not coverage.counts[0, 1][:, 8:].any()
    assert "at least 20 % of the cells" in coverage.words()


def test_the_coverage_map_has_one_cell_per_discrete_action() -> None:
    q = np.zeros((2, 4))
    coverage = coverage_of(cartpole(), q, np.array([[0.0], [1.0]]))
    assert int((coverage.counts[3, 4] > 0).sum()) == 2


def test_the_coverage_picture_has_a_panel_for_each_pair_of_columns() -> None:
    figure = draw_coverage(coverage_of(pendulum(), *steps((-8, 8))))
    drawn = [axes for axes in figure.axes if axes.images]
    assert len(drawn) == 3
    assert {axes.get_title() for axes in drawn} == {"100 %"}


def test_the_coverage_picture_of_many_columns_includes_the_actions() -> None:
    names = [*(f"s{i}" for i in range(12)), "action 0", "action 1"]
    assert columns_shown(names) == [0, 1, 2, 3, 4, 5, 12, 13]
