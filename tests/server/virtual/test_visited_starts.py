"""A share of episodes starts at states of real steps, and rewards are lowered where the model doubts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel
from surrogym_server.virtual import step

VISITED = torch.tensor([[2.0, 5.0], [-2.5, 6.0], [3.0, -7.0]], dtype=torch.float64)  # declared starts are slower
STATES = {tuple(row) for row in VISITED.tolist()}


def at_visited(lanes) -> np.ndarray:
    return np.array([tuple(row) in STATES for row in lanes.q.tolist()])


def test_the_share_of_episodes_given_by_start_visited_starts_at_sampled_states(pendulum_model: ExactModel, started):
    _, lanes = started(pendulum_model, 2_000, start_visited=0.5, visited=VISITED)
    assert at_visited(lanes).mean() == pytest.approx(0.5, abs=0.05)
    assert {tuple(row) for row in lanes.q[at_visited(lanes)].tolist()} == STATES, "each of them"
    assert (lanes.q[~at_visited(lanes), 1].abs() <= 1).all(), "the others start as declared"


def test_the_start_shares_start_visited_and_start_box_can_be_combined(pendulum_model: ExactModel, started):
    _, lanes = started(pendulum_model, 4_000, start_visited=0.25, start_box=0.5, visited=VISITED)
    anywhere = ~at_visited(lanes) & (lanes.q[:, 1].abs() > 1).numpy()
    assert at_visited(lanes).mean() == pytest.approx(0.25, abs=0.04)
    assert anywhere.mean() == pytest.approx(0.5 * 7 / 8, abs=0.04)


def test_start_visited_0_leaves_start_states_unchanged(pendulum_model: ExactModel, started):
    for share in (0.0, 0.5):
        plain, beside = (
            started(pendulum_model, 50, start_box=share)[1],
            started(pendulum_model, 50, start_box=share, visited=None, start_visited=0.0)[1],
        )
        np.testing.assert_array_equal(plain.q, beside.q)


def test_the_option_caution_lowers_the_reward_by_the_models_uncertainty(pendulum_model: ExactModel, started):
    """The dynamics deviate by 0.5 and the reward by the angle, in deviations of 1 over the samples."""
    unsure = replace(pendulum_model, std=0.5, reward_std=lambda q: q[:, 0].abs())
    settings, lanes = started(unsure, 3, caution=2.0)
    q = torch.tensor([[0.1, 0.0], [0.8, 0.0], [-2.0, 0.0]], dtype=torch.float64)
    _, transition = step(unsure, settings, replace(lanes, q=q), np.zeros((3, 1)))
    np.testing.assert_allclose(transition.reward_mean - transition.reward, [1.0, 1.6, 4.0])
    assert transition.std is None, "nobody asked for it"
    _, sure = step(pendulum_model, settings, replace(lanes, q=q), np.zeros((3, 1)))
    np.testing.assert_array_equal(sure.reward, sure.reward_mean)


def test_the_caution_penalty_is_relative_to_the_deviation_of_the_samples(pendulum_model: ExactModel, started):
    class Wider(ExactModel):
        @property
        def scales(self) -> torch.Tensor:
            return torch.tensor([1.0, 10.0, 4.0], dtype=torch.float64)

    wider = Wider(**{name: getattr(pendulum_model, name) for name in pendulum_model.__dataclass_fields__})
    settings, lanes = started(replace(wider, std=0.5), 2, caution=1.0)
    _, transition = step(replace(wider, std=0.5), settings, lanes, np.zeros((2, 1)))
    np.testing.assert_allclose(transition.reward_mean - transition.reward, 0.5 / 1.0 * 4.0)


def test_the_option_caution_lowers_rewards_of_the_particle_variant_too(pendulum_model: ExactModel, started):
    unsure = replace(pendulum_model, std=0.5)
    settings, lanes = started(unsure, 2, caution=2.0, variant="probabilistic", particles=3)
    _, transition = step(unsure, settings, lanes, np.zeros((2, 1)))
    np.testing.assert_allclose(transition.reward_mean - transition.reward, 1.0)
