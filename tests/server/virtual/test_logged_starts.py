"""A surrogate of a log: episodes start where the log has been, and pay for leaving its ranges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel
from surrogym_server.virtual import step
from surrogym_shared.spec import Uniform

STATES = ((0.1, 1.0), (-2.0, 0.5), (3.0, -1.0))
OUTSIDE = -7.0
STILL = np.zeros((2, 1))


@pytest.fixture
def of_a_log(pendulum_model: ExactModel) -> ExactModel:
    """The pendulum, whose log has three states; its speed is sampled up to 4, and nothing stops it there."""
    angle, speed = pendulum_model.definition.coordinates
    slow = speed.model_copy(update={"sampling": Uniform(low=-4.0, high=4.0)})
    definition = replace(
        pendulum_model.definition, starts=STATES, outside_reward=OUTSIDE, coordinates=(angle, slow), time_limit=10
    )
    return replace(pendulum_model, definition=definition)


def test_virtual_episodes_of_a_log_surrogate_start_at_logged_states(of_a_log, started):
    _, lanes = started(of_a_log, 300)
    found = {tuple(row) for row in lanes.q.tolist()}
    assert found == set(STATES)


def test_with_start_box_half_of_the_log_surrogates_episodes_start_anywhere(of_a_log, started):
    _, lanes = started(of_a_log, 300, start_box=0.5)
    elsewhere = sum(tuple(row) not in set(STATES) for row in lanes.q.tolist())
    assert 100 < elsewhere < 200


def test_leaving_the_logs_range_terminates_and_pays_a_reward_for_each_missing_step(of_a_log, started):
    settings, lanes = started(of_a_log, 2, time_limit=10)
    lanes = replace(lanes, q=torch.tensor([[1.5, 3.9], [0.0, 0.0]], dtype=torch.float64), elapsed=lanes.elapsed + 4)
    _, moved = step(of_a_log, settings, lanes, STILL)
    assert moved.terminated.tolist() == [True, False]
    assert moved.reward[0] == moved.reward_mean[0] == OUTSIDE * 6, "this step and five more"
    assert moved.reward[1] > OUTSIDE
    assert not moved.truncated.any()


def test_an_episode_ended_by_the_limit_on_uncertainty_pays_the_reward_for_leaving_the_log(of_a_log, started):
    unsure = replace(of_a_log, std=0.5)
    settings, lanes = started(unsure, 2, time_limit=10, trust=0.4)
    _, moved = step(unsure, settings, lanes, STILL)
    assert moved.terminated.all()
    np.testing.assert_array_equal(moved.reward, [10 * OUTSIDE] * 2)


def test_without_a_reward_for_leaving_it_leaving_the_sampling_range_does_not_terminate(of_a_log, started):
    model = replace(of_a_log, definition=replace(of_a_log.definition, outside_reward=None))
    settings, lanes = started(model, 2)
    lanes = replace(lanes, q=torch.tensor([[1.5, 3.9], [0.0, 0.0]], dtype=torch.float64))
    _, moved = step(model, settings, lanes, STILL)
    assert not moved.terminated.any()
