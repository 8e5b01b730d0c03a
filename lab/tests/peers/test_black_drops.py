"""Black-DROPS searches within its bounds, and its imagined returns are means of sampled rollouts."""

import numpy as np
import torch

from surrogym_lab.peers.methods.black_drops import BOUND, Imagined, Settings, search
from surrogym_lab.peers.methods.gaussian_process import conditioned
from surrogym_lab.peers.methods.states import States, Transitions
from surrogym_lab.peers.methods.told import told
from surrogym_sampler.original import make


def test_the_black_drops_search_finds_the_maximum_within_its_bounds():
    top = np.array([0.5, -2.0, 9.0])

    def returns(theta, rollouts=1):
        return -((theta - top) ** 2).sum(1)

    settings = Settings(evaluations=1_500)
    found = search(returns, settings, 3, np.random.default_rng(0), None, lambda: None)
    np.testing.assert_allclose(found, [0.5, -2.0, BOUND], atol=0.05)


def test_the_black_drops_search_includes_the_previous_policy():
    def returns(theta, rollouts=1):
        return theta.sum(1)

    best = np.array([4.0, 4.0])
    settings = Settings(evaluations=1)
    found = search(returns, settings, 2, np.random.default_rng(0), best, lambda: None)
    assert found.sum() >= 8.0


def imagined():
    """A cart that rests in the model."""
    spec = make("CartPole-v1").spec()
    states, rng = States(spec), np.random.default_rng(0)
    q = rng.uniform(-0.2, 0.2, (20, 4))
    one = torch.ones(4).double()
    x = torch.from_numpy(np.concatenate([q, np.ones((20, 1))], 1))
    model = conditioned(x, torch.zeros(20, 4).double(), torch.ones(4, 5).double(), 1e-6 * one, 1e-3 * one)
    seen = Transitions(q, np.ones((20, 1)), q)
    return Imagined(states, told(spec), model, seen, np.abs(q).max(0), Settings())


def test_the_imagined_return_of_a_resting_cart_is_one_per_step():
    made = imagined()
    theta = np.random.default_rng(1).uniform(-1, 1, (3, made.size))
    np.testing.assert_allclose(made.returns(theta, np.random.default_rng(2)), 500.0)


def test_batched_policies_give_the_same_controls_as_single_ones():
    made, rng = imagined(), np.random.default_rng(3)
    theta, q = rng.uniform(-1, 1, (3, made.size)), rng.uniform(-1, 1, (3, 2, 4))
    alone = np.stack([made.controls(theta[i : i + 1], q[i : i + 1])[0] for i in range(3)])
    np.testing.assert_allclose(made.controls(theta, q), alone)
    assert alone.shape == (3, 2, 1)
    assert np.abs(alone).max() <= 1
