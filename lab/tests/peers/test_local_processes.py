"""Local processes predict as exact ones from all samples, and from the nearest ones alone otherwise."""

from functools import partial

import numpy as np
import pytest
import torch

from surrogym_lab.peers.methods.black_drops import Settings
from surrogym_lab.peers.methods.gaussian_process import conditioned
from surrogym_lab.peers.methods.local_processes import LocalProcesses, Nearest
from surrogym_lab.peers.port import BudgetSpent, Clock, Real
from surrogym_sampler.original import make
from surrogym_sampler.original.episodes import open_episode

RNG = np.random.default_rng(0)
X, Y = RNG.uniform(-1, 1, (30, 3)), RNG.standard_normal((30, 2))
POINTS = torch.from_numpy(RNG.uniform(-1, 1, (7, 3)))
SCALES = torch.tensor([[1.0, 0.5, 2.0], [0.3, 1.0, 1.0]]).double()


def exact(x, y):
    signal, noise = torch.tensor([1.0, 2.0]).double(), torch.tensor([0.1, 0.2]).double()
    return conditioned(torch.from_numpy(x), torch.from_numpy(y), SCALES, signal, noise)


@pytest.mark.parametrize("most", [30, 100])
def test_local_processes_with_all_samples_are_exact(most):
    for local, whole in zip(Nearest(exact(X, Y), X, Y, most).predict(POINTS), exact(X, Y).predict(POINTS), strict=True):
        np.testing.assert_allclose(local, whole, rtol=1e-6, atol=1e-8)


def test_a_local_prediction_is_the_posterior_of_the_nearest_samples():
    """Near by the length scales of each output, which differ here."""
    mean, deviation = Nearest(exact(X, Y), X, Y, 5).predict(POINTS)
    for i, point in enumerate(POINTS.numpy()):
        for output, scale in enumerate(SCALES.numpy()):
            near = np.argsort((((X - point) / scale) ** 2).sum(1))[:5]
            expected = (part[0, output] for part in exact(X[near], Y[near]).predict(POINTS[i : i + 1]))
            np.testing.assert_allclose([mean[i, output], deviation[i, output]], list(expected), rtol=1e-6)


def test_local_processes_learn_after_each_episode():
    spec = make("Pendulum-v1").spec()
    opener = partial(open_episode, "Pendulum-v1", spec, partial(make, "Pendulum-v1", spec=spec))
    real = Real(spec, opener, 0, 160, Clock(600))
    rounds = LocalProcesses(Settings(evaluations=20), nearest=5).learn(real, 0)
    for taken in (80, 160):
        policy = next(rounds)
        assert real.steps == taken
        assert np.abs(policy.actions([0], np.array([[1, 0, 0]], np.float32))).max() <= 2
    with pytest.raises(BudgetSpent):
        next(rounds)
    real.close()
