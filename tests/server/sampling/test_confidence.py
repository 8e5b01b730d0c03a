"""Equations 8 to 10 and 12 against numbers worked out by hand from a table of the normal distribution.

Phi(0.5) = 0.6914624613, Phi(1) = 0.8413447461, Phi(2) = 0.9772498681, Phi(5) = 0.9999997133.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from support.models import learn
from support.real_steps import join
from surrogym_server.sampling.confidence import (
    certainty,
    confidence,
    log_model_uncertainty,
    stds,
)
from surrogym_server.sampling.occupancy import log_occupancy
from surrogym_server.sampling.uncertainty import query_uncertainty, visited_confidence

TIGHT = [1e-6, 1e-6, 1e-6]


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_the_confidence_index_equals_its_formula_and_that_of_the_paper():
    made = confidence(tensor(0.1, 0.05, 0.2), 0.1, None)
    assert made.confidence_index == pytest.approx((0.8413447461 + 0.9772498681 + 0.6914624613) / 3, abs=1e-9)
    assert made.confidence_index_paper == pytest.approx((1 + 1 + 0.9999997133) / 3, abs=1e-9)
    assert made.coverage == pytest.approx(2 / 3)


def test_with_tolerance_1_the_confidence_index_equals_that_of_the_paper():
    made = confidence(tensor(1.0, 2.0), 1.0, None)
    assert made.confidence_index == made.confidence_index_paper == pytest.approx((0.8413447461 + 0.6914624613) / 2)


def test_certainty_is_one_half_at_infinite_deviation_and_one_at_zero():
    torch.testing.assert_close(certainty(tensor(1e12, 0.0), 0.1), tensor(0.5, 1.0))
    assert log_model_uncertainty(tensor(0.0), 0.1).exp().item() == 0
    assert math.isfinite(log_model_uncertainty(tensor(0.0), 0.1).item()), "as JSON has no infinity"


def test_model_uncertainty_is_one_minus_certainty():
    log_u = log_model_uncertainty(tensor(0.1, 0.05), 0.1)
    torch.testing.assert_close(log_u.exp(), tensor(1 - 0.8413447461, 1 - 0.9772498681), rtol=1e-8, atol=0)


def test_tiny_model_uncertainties_stay_ordered_in_the_logarithm():
    std = tensor(1 / 9, 1 / 10, 1 / 20, 1 / 100)
    assert torch.all(1 - certainty(std, 1.0) == 0)
    log_u = log_model_uncertainty(std, 1.0)
    assert torch.all(log_u.diff() < 0)
    np.testing.assert_allclose(log_u.numpy(), norm.logsf([9, 10, 20, 100]), rtol=1e-9)


def test_query_uncertainty_returns_mean_deviation_probability_and_index_of_each_output(model, points, unseen):
    q, u = (t.numpy() for t in points)
    tolerances = np.array([0.01, 0.02, 0.1])
    made = query_uncertainty(model, q, u, tolerances)
    np.testing.assert_allclose(made.std, stds(model, *points).numpy())
    np.testing.assert_allclose(made.model_uncertainty, norm.sf(tolerances / made.std), rtol=1e-9)
    np.testing.assert_allclose(made.input_probability, 1)
    np.testing.assert_allclose(made.mean, model.means(*points).numpy())
    visited = query_uncertainty(model, q, u, tolerances, unseen.q.numpy())
    p = log_occupancy(model.definition, unseen.q, points[0]).exp().numpy()
    np.testing.assert_allclose(visited.input_probability, np.repeat(p[:, None], 3, 1))
    index = visited.model_uncertainty * visited.input_probability
    np.testing.assert_allclose(np.exp(visited.log_uncertainty_index), index, rtol=1e-9)


def test_the_confidence_over_visited_states_is_that_of_the_worst_output(model):
    states = np.array([[0.0, 1.0], [1.0, -2.0], [0.5, 0.5]])
    alone = [visited_confidence(model, states, [t if i == j else 1e9 for j in range(3)]) for i, t in enumerate(TIGHT)]
    assert visited_confidence(model, states, TIGHT) == min(alone)
    assert max(alone) > min(alone)
    assert visited_confidence(model, states, [1e9] * 3) == 1.0
    assert visited_confidence(model, states, [1e-15] * 3) == pytest.approx(0.5)


def test_visited_states_outside_the_sampling_range_lower_the_confidence(definition, few, unseen):
    more = replace(unseen, **{n: getattr(unseen, n)[:10] for n in unseen.__dataclass_fields__})
    model, within = learn(definition, join(few, more)).model, np.array([[0.5, 0.5]])
    known = visited_confidence(model, within, [1e-2] * 3)
    fled = visited_confidence(model, np.concatenate([within, [[0.5, 800.0]]]), [1e-2] * 3)
    assert known > 0.999
    assert fled < 0.8
