"""The ensemble learns means and variances, and the cross-entropy method finds the best plan."""

import numpy as np
import pytest
import torch

from surrogym_lab.peers.methods.ensemble import Ensemble, negative_log_likelihood, train
from surrogym_lab.peers.methods.pets import Planner, Planning, Settings, cross_entropy
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.methods.told import told
from surrogym_sampler.original import make
from surrogym_shared.terms import observe


def test_the_pets_loss_equals_the_normal_negative_log_likelihood():
    rng = np.random.default_rng(0)
    mean, log_variance, y = (torch.from_numpy(rng.standard_normal((3, 5, 2))) for _ in range(3))
    normal = torch.distributions.Normal(mean, torch.exp(log_variance / 2))
    constant = np.log(2 * np.pi)
    expected = (-2 * normal.log_prob(y) - constant).mean((-2, -1)).sum()
    np.testing.assert_allclose(negative_log_likelihood(mean, log_variance, y), expected)


def test_the_pets_ensemble_learns_a_mean_and_input_dependent_noise():
    torch.manual_seed(0)
    x = torch.rand(600, 1) * 2 - 1
    y = torch.sin(2 * x) + torch.where(x > 0, 0.3, 0.03) * torch.randn_like(x)
    model = Ensemble(1, 1, networks=2, hidden=(32, 32), decay=(1e-5,) * 3)
    train(model, torch.optim.Adam(model.parameters(), 3e-3), x, y, epochs=60, batch=32, check=lambda: None)
    at = torch.tensor([[-0.5], [0.5]])
    mean, log_variance = model(at.expand(2, 2, 1))
    deviation = torch.exp(log_variance / 2).mean(0)[:, 0]
    np.testing.assert_allclose(mean.mean(0).detach(), torch.sin(2 * at), atol=0.12, rtol=0)
    assert deviation[0] < 0.1 < 0.2 < deviation[1] < 0.45


def test_the_cross_entropy_method_finds_a_maximum():
    top = np.array([[0.6, -0.3], [-0.9, 0.1]])
    found = cross_entropy(
        lambda plans: -((plans - top) ** 2).sum((1, 2)),
        np.zeros((2, 2)),
        population=200,
        elites=20,
        iterations=12,
        smoothing=0.1,
        rng=np.random.default_rng(0),
    )
    np.testing.assert_allclose(found, top, atol=0.05)


class Exact(torch.nn.Module):
    """Changes of a cart that a control moves by a tenth."""

    def forward(self, x):
        mean = torch.zeros(*x.shape[:-1], 4)
        mean[..., 0] = 0.1 * x[..., -1]
        return mean, torch.full_like(mean, -40.0)


def test_the_return_of_a_plan_sums_the_models_rewards_until_termination():
    spec = make("CartPole-v1").spec()
    settings = Settings(networks=2, particles=4)
    planner = Planner(States(spec), told(spec), Exact(), settings, np.random.default_rng(0))
    plans = np.stack([np.ones((10, 1)), -np.ones((10, 1))])
    earned = planner.returns(np.array([2.15, 0, 0, 0]), plans)  # three steps to the right end the episode
    assert earned.tolist() == [3.0, 10.0]


def test_parallel_episodes_have_separate_plans():
    spec = make("CartPole-v1").spec()
    planner = Planner(States(spec), told(spec), Exact(), Settings(networks=2, particles=4), np.random.default_rng(0))
    shown = observe(spec, np.array([[2.3, 0, 0, 0], [-2.3, 0, 0, 0]])).astype(np.float32)
    assert Planning(planner, 1).actions([0, 1], shown) == pytest.approx(np.array([[0.0], [1.0]]))
