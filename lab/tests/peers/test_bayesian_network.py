"""A mask is one function, particles keep mean and covariance, and the policy's search follows the slope of the cost."""

from functools import partial

import numpy as np
import pytest
import torch

from surrogym_lab.peers.methods.bayesian_network import (
    BayesianNetwork,
    Particles,
    Policy,
    Settings,
    matched,
    search,
    tip_costs,
)
from surrogym_lab.peers.methods.belief import costs_of
from surrogym_lab.peers.methods.dropout_network import DropoutNetwork, train
from surrogym_lab.peers.methods.pilco import start_beliefs
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.methods.told import TOLD
from surrogym_lab.peers.port import BudgetSpent, Clock, NotApplicable, Real
from surrogym_sampler.original import make
from surrogym_sampler.original.episodes import open_episode

SWING_UP = "surrogym/CartPoleSwingUpNarrow-v0"
SMALL = Settings(hidden=8, training=5, search=2, particles=10, basis=5)


def taught(n=200, steps=800):
    """A network that learned a sine between -1 and 1."""
    torch.manual_seed(0)
    x = torch.rand(n, 1).double() * 2 - 1
    model = DropoutNetwork(1, 1, hidden=100, rate=0.05)
    optimizer = torch.optim.Adam(model.parameters(), 3e-3, weight_decay=1e-4)
    train(model, optimizer, x, torch.sin(2 * x), steps, 100, lambda: None)
    return model


def test_a_bayesian_network_is_uncertain_far_from_its_samples():
    model, n = taught(), 200
    inside, outside = torch.full((n, 1), 0.3).double(), torch.full((n, 1), 4.0).double()
    masks = model.masks(n)
    near, far = model(inside, masks), model(outside, masks)
    assert near.mean().item() == pytest.approx(np.sin(0.6), abs=0.1)
    assert far.std() > 3 * near.std()


def test_a_dropout_mask_gives_the_same_function_at_every_call():
    model = taught(steps=1)
    x, masks = torch.rand(6, 1).double(), model.masks(6)
    torch.testing.assert_close(model(x, masks), model(x, masks))
    assert not torch.equal(model(x, masks), model(x, model.masks(6)))


def test_redrawn_particles_keep_the_mean_and_covariance():
    rng = np.random.default_rng(0)
    root = torch.from_numpy(rng.standard_normal((2, 3, 3)))
    q = torch.from_numpy(rng.standard_normal((2, 20_000, 3))) @ root.mT + torch.arange(3).double()
    drawn = matched(q, torch.from_numpy(rng.standard_normal(q.shape)))
    torch.testing.assert_close(drawn.mean(1), q.mean(1), atol=0.06, rtol=0)
    for wanted, got in zip(q, drawn, strict=True):
        torch.testing.assert_close(torch.cov(got.T), torch.cov(wanted.T), atol=0.2, rtol=0)


@pytest.mark.parametrize("name", [SWING_UP, "Acrobot-v1", "CartPole-v1"])
def test_the_cost_of_a_state_equals_pilcos_cost_of_a_narrow_gaussian(name):
    q = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (4, 4)))
    narrow = 1e-10 * torch.eye(4).double().expand(4, 4, 4)
    cost = TOLD[name].cost
    torch.testing.assert_close(tip_costs(cost, q), costs_of(cost, q, narrow), atol=1e-6, rtol=1e-5)


def imagined(count=50):
    torch.manual_seed(0)
    spec = make("Pendulum-v1").spec()
    states = States(spec)
    model = DropoutNetwork(4, 2, hidden=20, rate=0.1).requires_grad_(False)
    beliefs = start_beliefs(spec, 2)
    policy = Policy(states, beliefs[0], 6, np.random.default_rng(1))
    return Particles(states, model, TOLD["Pendulum-v1"].cost, beliefs, count), policy


def test_the_gradient_of_the_bayesian_network_policy_cost_equals_finite_differences():
    particles, policy = imagined()

    def cost():
        torch.manual_seed(3)  # the same masks and particles
        return particles.cost(policy, 5)

    cost().backward()
    along = 1e-3 * torch.randn(policy.centres.shape).double()
    slope = (policy.centres.grad * along).sum().item()
    with torch.no_grad():
        policy.centres += along
        ahead = cost()
        policy.centres -= 2 * along
        behind = cost()
    assert slope == pytest.approx((ahead - behind).item() / 2, rel=0.05)


def test_a_bayesian_network_policy_search_lowers_the_cost():
    particles, policy = imagined()

    def mean_cost():
        torch.manual_seed(5)
        with torch.no_grad():
            return np.mean([particles.cost(policy, 10).item() for _ in range(20)])

    before = mean_cost()
    search(policy, partial(particles.cost, policy, 10), Settings(search=100), lambda: None)
    assert mean_cost() < before - 0.05


def test_the_bayesian_network_policy_stays_within_its_action_limits():
    _, policy = imagined()
    with torch.no_grad():
        policy.weights *= 100
    assert np.abs(policy.control(np.random.default_rng(0).uniform(-3, 3, (100, 2)))).max() <= 1


def test_each_bayesian_network_round_is_one_episode_and_leaves_earlier_policies_unchanged():
    spec = make(SWING_UP).spec()
    real = Real(spec, lambda: open_episode(SWING_UP, spec, lambda: make(SWING_UP)), 0, 90, Clock(600.0))
    found = []

    def learn():
        for policy in BayesianNetwork(SMALL).learn(real, 0):
            shown = np.random.default_rng(0).standard_normal((2, 6)).astype(np.float32)
            found.append((real.steps, policy, policy.actions([0, 1], shown)))

    with pytest.raises(BudgetSpent):
        learn()
    assert [steps for steps, *_ in found] == [40, 80]
    _, policy, acted = found[0]
    shown = np.random.default_rng(0).standard_normal((2, 6)).astype(np.float32)
    np.testing.assert_allclose(policy.actions([2, 3], shown), acted)


def test_the_bayesian_network_method_refuses_a_task_without_a_known_cost_function():
    spec = make("MountainCar-v0").spec()
    real = Real(spec, lambda: open_episode("MountainCar-v0", spec, lambda: make("MountainCar-v0")), 0, 9, Clock(600.0))
    with pytest.raises(NotApplicable):
        next(BayesianNetwork(SMALL).learn(real, 0))
