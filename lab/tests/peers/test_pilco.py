"""PILCO's belief follows the policy and the model, compiled as in torch, its gradient is the cost's slope, and starts
are covered."""

from functools import partial

import numpy as np
import torch

from surrogym_lab.peers.methods import belief, pilco
from surrogym_lab.peers.methods.gaussian_process import conditioned
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.methods.told import TOLD
from surrogym_sampler.original import make
from surrogym_shared.spec import BoxAction

SPEC = make("Pendulum-v1").spec()
STATES = States(SPEC)


def model():
    rng = np.random.default_rng(0)
    x, y = torch.from_numpy(rng.uniform(-1, 1, (15, 4))), torch.from_numpy(0.3 * rng.standard_normal((15, 2)))
    one = torch.ones(2).double()
    return conditioned(x, y, torch.ones(2, 4).double(), one, 0.1 * one)


def parameters(basis=6):
    rng = np.random.default_rng(1)
    theta = pilco._first_parameters(STATES, pilco.start_beliefs(SPEC, 4), pilco.Settings(basis), rng)
    return theta + 0.3 * rng.standard_normal(len(theta))


def test_a_narrow_gaussian_state_moves_as_the_pilco_model_predicts():
    policy, at = pilco._policy(STATES, parameters()), np.array([[0.4, -0.7]])
    narrow = 1e-8 * torch.eye(2).double()[None]
    mean, covariance = belief.next_belief(STATES, model(), policy, torch.from_numpy(at), narrow)
    inputs = np.concatenate([STATES.featured(at), pilco._acting(STATES, policy)(at)], 1)
    change, deviation = model().predict(torch.from_numpy(inputs))
    np.testing.assert_allclose(mean, torch.from_numpy(at) + change, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(covariance[0].diagonal().sqrt(), deviation[0], atol=1e-3, rtol=1e-2)


def test_the_gradient_of_the_pilco_cost_equals_finite_differences():
    objective = partial(
        belief.expected_cost,
        belief.Imagination(STATES, model()),
        TOLD["Pendulum-v1"].cost,
        pilco.start_beliefs(SPEC, 2),
        4,
    )
    theta = parameters()
    along = np.random.default_rng(2).standard_normal(len(theta)) * 1e-5
    leaf = torch.from_numpy(theta).requires_grad_()
    objective(pilco._policy(STATES, leaf)).backward()
    ahead, behind = (objective(pilco._policy(STATES, theta + sign * along)).item() for sign in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2, leaf.grad.numpy() @ along, rtol=1e-4)


def test_compiled_pilco_episodes_equal_those_of_torch():
    """Values and gradients, with two angles and two controls, whose covariances a single one would not have."""
    action = BoxAction(low=(-1.0, -1.0), high=(1.0, 1.0))
    states, rng = States(make("Acrobot-v1").spec().model_copy(update={"action": action})), np.random.default_rng(5)
    x, y = rng.uniform(-1, 1, (20, 8)), 0.3 * rng.standard_normal((20, 4))
    lengthscale, signal = rng.uniform(0.7, 2, (4, 8)), rng.uniform(0.5, 1.5, 4)
    learned = conditioned(*map(torch.from_numpy, (x, y, lengthscale, signal, 0.1 * signal)))
    theta = rng.standard_normal(7 * 6 + 7 * 2 + 6) / 2
    root = 0.3 * rng.standard_normal((2, 4, 4))
    start = torch.from_numpy(rng.standard_normal((2, 4))), torch.from_numpy(root @ root.transpose(0, 2, 1))
    by_means, by_covariances = (torch.from_numpy(rng.standard_normal((3, 2, *shape))) for shape in ((4,), (4, 4)))
    by_covariances = by_covariances + by_covariances.mT

    def imagined(policy):
        found = [start]
        for _ in range(3):
            found.append(belief.next_belief(states, learned, policy, *found[-1]))
        return tuple(torch.stack(part) for part in zip(*found[1:], strict=True))

    def compiled(policy):
        return belief.Imagination(states, learned)(policy, *start, 3)

    slopes = []
    for follow in (imagined, compiled):
        leaf = torch.from_numpy(theta).requires_grad_()
        means, covariances = follow(pilco._policy(states, leaf))
        ((means * by_means).sum() + (covariances * by_covariances).sum()).backward()
        slopes.append((means.detach(), covariances.detach(), leaf.grad))
    for wanted, got in zip(*slopes, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-10)


def test_a_pilco_policy_search_lowers_the_cost():
    objective = partial(
        belief.expected_cost,
        belief.Imagination(STATES, model()),
        TOLD["Pendulum-v1"].cost,
        pilco.start_beliefs(SPEC, 2),
        4,
    )
    theta = parameters()
    found = pilco._improved(objective, theta, STATES, pilco.Settings(iterations=5), lambda: None)
    assert objective(pilco._policy(STATES, found)) < objective(pilco._policy(STATES, theta)) - 1e-3


def test_start_angles_over_the_whole_circle_are_split_into_several_gaussians():
    means, covariances = pilco.start_beliefs(SPEC, 4)
    np.testing.assert_allclose(means[:, 0], np.pi * np.array([-0.75, -0.25, 0.25, 0.75]))
    np.testing.assert_allclose(covariances[0].diagonal(), [(np.pi / 2) ** 2 / 12, 4 / 12])
    assert len(pilco.start_beliefs(make("CartPole-v1").spec(), 4)[0]) == 1


def test_the_pilco_policy_stays_within_its_action_limits():
    control = pilco._acting(STATES, pilco._policy(STATES, 50 * parameters()))
    assert np.abs(control(np.random.default_rng(0).uniform(-3, 3, (100, 2)))).max() <= 1
