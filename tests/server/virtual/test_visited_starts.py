"""A share of episodes starts at states of real steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel

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
