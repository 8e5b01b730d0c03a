"""PILCO's belief follows the policy and the model, its gradient is the cost's slope, and starts are covered."""

from functools import partial

import numpy as np
import torch

from surrogym_client.experiments.peers.methods import pilco
from surrogym_client.experiments.peers.methods.gaussian_process import conditioned
from surrogym_client.experiments.peers.methods.states import States
from surrogym_client.experiments.peers.methods.told import TOLD
from surrogym_client.original import make

SPEC = make("Pendulum-v1").spec()
STATES = States(SPEC)


def model():
    rng = np.random.default_rng(0)
    x, y = torch.from_numpy(rng.uniform(-1, 1, (15, 4))), torch.from_numpy(0.3 * rng.standard_normal((15, 2)))
    one = torch.ones(2).double()
    return conditioned(x, y, torch.ones(2, 4).double(), one, 0.1 * one)


def parameters(basis=6):
    rng = np.random.default_rng(1)
    theta = pilco._first_parameters(STATES, pilco.start_beliefs(SPEC, 4)[0], basis, rng)
    return theta + 0.3 * rng.standard_normal(len(theta))


def test_a_narrow_belief_moves_as_the_model_says():
    policy, at = pilco._policy(STATES, parameters()), np.array([[0.4, -0.7]])
    narrow = 1e-8 * torch.eye(2).double()[None]
    mean, covariance = pilco._next_belief(STATES, model(), policy, torch.from_numpy(at), narrow)
    inputs = np.concatenate([STATES.featured(at), pilco._acting(STATES, policy)(at)], 1)
    change, deviation = model().predict(torch.from_numpy(inputs))
    np.testing.assert_allclose(mean, torch.from_numpy(at) + change, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(covariance[0].diagonal().sqrt(), deviation[0], atol=1e-3, rtol=1e-2)


def test_the_gradient_is_the_slope_of_the_cost():
    objective = partial(
        pilco._expected_cost, STATES, model(), TOLD["Pendulum-v1"].cost, pilco.start_beliefs(SPEC, 2), 4
    )
    theta = parameters()
    along = np.random.default_rng(2).standard_normal(len(theta)) * 1e-5
    leaf = torch.from_numpy(theta).requires_grad_()
    objective(pilco._policy(STATES, leaf)).backward()
    ahead, behind = (objective(pilco._policy(STATES, theta + sign * along)).item() for sign in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2, leaf.grad.numpy() @ along, rtol=1e-4)


def test_a_search_lowers_the_cost():
    objective = partial(
        pilco._expected_cost, STATES, model(), TOLD["Pendulum-v1"].cost, pilco.start_beliefs(SPEC, 2), 4
    )
    theta = parameters()
    found = pilco._improved(objective, theta, STATES, pilco.Settings(iterations=5), lambda: None)
    assert objective(pilco._policy(STATES, found)) < objective(pilco._policy(STATES, theta)) - 1e-3


def test_a_circle_of_starts_has_several_beliefs():
    means, covariances = pilco.start_beliefs(SPEC, 4)
    np.testing.assert_allclose(means[:, 0], np.pi * np.array([-0.75, -0.25, 0.25, 0.75]))
    np.testing.assert_allclose(covariances[0].diagonal(), [(np.pi / 2) ** 2 / 12, 4 / 12])
    assert len(pilco.start_beliefs(make("CartPole-v1").spec(), 4)[0]) == 1


def test_the_policy_stays_within_its_limits():
    control = pilco._acting(STATES, pilco._policy(STATES, 50 * parameters()))
    assert np.abs(control(np.random.default_rng(0).uniform(-3, 3, (100, 2)))).max() <= 1
