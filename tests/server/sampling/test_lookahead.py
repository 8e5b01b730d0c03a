"""What a query would do to the deviations is what it does, and is known before its answer."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import encode
from surrogym_server.environment.points import Points
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.lookahead import _log_determinants
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.sampling.confidence import stds
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_server.sampling.lookahead import outlook_of
from surrogym_shared.spec import Reward

NOTHING = slice(0)


@pytest.fixture
def candidates(points) -> Points:
    return Points(*points)


@pytest.fixture
def reference(definition) -> Points:
    return Points(*random_points(definition, 25, np.random.default_rng(5)))


def answered(model: GaussianProcessModel, query: Points) -> GaussianProcessModel:
    """The model as if one query had been answered as predicted: every process has one more point."""
    lead = model.transition(query.q, query.u).q_next[:, 1:]

    def extended(output: OutputModel) -> OutputModel:
        x = encode(model.definition, output.feature_map, query.q, query.u, lead)
        return replace(output, posterior=output.posterior.extend(x[0], output.posterior.mean(x)[0]))

    return replace(model, transitions=tuple(map(extended, model.transitions)), reward=extended(model.reward))


def test_before_any_query_the_predicted_variances_equal_those_of_the_model(model, candidates):
    outlook = outlook_of(model, candidates, candidates[NOTHING], candidates[NOTHING])
    said = torch.stack([output.std for output in outlook], -1)
    torch.testing.assert_close(said, stds(model, candidates.q, candidates.u), rtol=1e-6, atol=1e-9)


def test_the_variance_reduction_predicted_for_a_query_equals_that_after_its_answer(model, candidates, reference):
    weights = torch.arange(1.0, 26.0, dtype=torch.float64) / 325
    outlook = outlook_of(model, candidates, reference, candidates[NOTHING])
    before = stds(model, reference.q, reference.u).square()
    for index in range(3):
        after = stds(answered(model, candidates[index : index + 1]), reference.q, reference.u).square()
        brought = weights @ (before - after)
        said = torch.stack([output.reduction(weights)[index] for output in outlook])
        torch.testing.assert_close(said, brought, rtol=1e-4, atol=1e-10)


def test_pending_queries_lower_the_predicted_variance_like_observed_ones(model, candidates, reference):
    weights = torch.full((25,), 1 / 25, dtype=torch.float64)
    observed = [o.observe(4).observe(9) for o in outlook_of(model, candidates, reference, candidates[NOTHING])]
    assumed = outlook_of(model, candidates, reference, candidates[[4, 9]])
    for one, other in zip(observed, assumed, strict=True):
        torch.testing.assert_close(one.std, other.std, rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(one.reduction(weights), other.reduction(weights), rtol=1e-5, atol=1e-12)


def test_a_query_predicted_to_end_at_a_bound_does_not_reduce_dynamics_variance(model):
    """It is left out of the processes, so asking for it would not lower their deviations."""
    q = torch.tensor([[1.5, 7.9], [1.5, 0.0]], dtype=torch.float64)
    points = Points(q, torch.full((2, 1), 2.0, dtype=torch.float64))
    theta, speed, reward = outlook_of(model, points, points[NOTHING], points[NOTHING])
    assert speed.learns.tolist() == [False, True]
    assert reward.learns.tolist() == [True, True]
    torch.testing.assert_close(speed.observe(0).std, speed.std)
    assert speed.observe(1).std[1] < speed.std[1]
    assert theta.learns.tolist() == [model.transitions[0].feature_map.lead, True]


def test_no_variance_is_predicted_for_a_constant_output():
    steps = random_steps(cartpole(), 12, seed=0)
    model = learn(definition_from_spec(cartpole()), steps).model
    points = Points(steps.q, steps.u)
    assert outlook_of(model, points, points, points)[-1] is None


def test_the_predicted_variance_of_a_reward_after_the_step_uses_the_predicted_next_state(candidates):
    spec = pendulum().model_copy(update={"reward": Reward(timing="after")})
    model = learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model
    outlook = outlook_of(model, candidates, candidates[NOTHING], candidates[NOTHING])
    expected = stds(model, candidates.q, candidates.u)[:, -1]
    torch.testing.assert_close(outlook[-1].std, expected, rtol=1e-6, atol=1e-9)


def test_information_along_a_path_survives_rounding_errors_and_values_that_are_not_finite():
    covariance, weight = torch.eye(2, dtype=torch.float64).repeat(4, 1, 1), torch.ones(4, 2, dtype=torch.float64)
    covariance[1, 0, 0], covariance[2, 1, 1], covariance[3] = -1e-9, torch.nan, torch.nan
    weight[1] = 1e5
    information = _log_determinants(covariance, weight)
    torch.testing.assert_close(information[0], torch.tensor([0.5, 1.0], dtype=torch.float64) * math.log(2))
    assert bool((information[:, 1:] >= information[:, :1] - 1e-9).all())
    assert bool((information >= -1e-9).all())
