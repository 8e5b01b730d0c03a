"""Pictures of episodes draw an angle as a line without jumps, so that equal positions look equal."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import EpisodeTrace, EvaluationDetail
from surrogym_trainer.report.decision import Meet, draw_episodes
from surrogym_trainer.report.known import with_whole_traces

ONE = [[3.0, 0.0], [-3.0, 0.0], [3.1, 0.0], [-3.1, 0.0]]
OTHER = [[-2.8, 0.0], [-3.1, 0.0], [3.0, 0.0], [2.9, 0.0]]


def trace(coordinates: list[list[float]]) -> EpisodeTrace:
    steps = len(coordinates) - 1
    return EpisodeTrace(rank="best", seed=0, coordinates=coordinates, action=[[0.0]] * steps, reward=[0.0] * steps)


@pytest.mark.parametrize(("meet", "at"), [("start", 0), ("end", -1)])
def test_episode_pictures_draw_angles_without_jumps(meet: Meet, at: int):
    figure = draw_episodes(pendulum(), [("one", trace(ONE)), ("other", trace(OTHER))], meet)
    drawn = [np.asarray(line.get_ydata()) for line in figure.axes[0].get_lines()]
    for values, given in zip(drawn, (ONE, OTHER), strict=True):
        assert np.abs(np.diff(values)).max() < 0.7
        assert np.exp(1j * values) == pytest.approx(np.exp(1j * np.array(given)[:, 0]))
    assert drawn[0][at] == ONE[at][0]
    assert abs(drawn[1][at] - drawn[0][at]) <= np.pi


def test_episode_traces_of_wrong_shape_are_left_out_and_reported():
    ragged = EpisodeTrace.model_construct(coordinates=[[0.0, 0.0], [0.0]], action=[[0.0]], reward=[0.0])
    wide = EpisodeTrace.model_construct(coordinates=[[0.0] * 3] * 2, action=[[0.0]], reward=[0.0])
    missing: list[str] = []
    stored = EvaluationDetail.model_construct(id=3, traces=[trace(ONE), ragged, wide])
    assert with_whole_traces(stored, pendulum(), missing).traces == [trace(ONE)]
    assert len(missing) == 1
    assert "2 traces of evaluation 3" in missing[0]
