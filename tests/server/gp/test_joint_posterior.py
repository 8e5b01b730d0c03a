"""A joint posterior is the posterior, and observing a point of it is conditioning on it, whatever its value."""

import pytest
import torch

from surrogym_server.gp import Hyperparameters, Joint, Posterior, condition


@pytest.fixture(params=[0.0, 1e-9], ids=["no jitter", "jitter"])
def posterior(request: pytest.FixtureRequest) -> Posterior:
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(12, 3, generator=generator, dtype=torch.float64)
    hyper = Hyperparameters(torch.tensor([0.8, 1.5, 3.0]).double(), 1.3, 0.4, 0.2, 1e-4)
    made = condition(hyper, x, x.sin().sum(1))
    return Posterior(hyper, x, made.y, made.factor, made.weights, request.param)


@pytest.fixture
def x() -> torch.Tensor:
    return 1.5 * torch.randn(30, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_the_joint_posterior_has_the_variances_of_the_posterior(posterior, x):
    joint = Joint.of(posterior, x)
    torch.testing.assert_close(joint.variance, posterior.mean_and_variance(x)[1])
    everywhere = joint.between(slice(None), slice(None))
    torch.testing.assert_close(everywhere.diagonal(), joint.variance, rtol=0, atol=1e-12)
    torch.testing.assert_close(joint.between(slice(5), slice(7, 9)), everywhere[:5, 7:9])


def test_observing_a_point_in_the_joint_posterior_equals_conditioning_on_it(posterior, x):
    joint, conditioned = Joint.of(posterior, x), posterior
    for index in (3, 17, 4):
        joint = joint.observe(index)
        conditioned = conditioned.extend(x[index], torch.tensor(7.0).double())
    expected = Joint.of(conditioned, x)
    torch.testing.assert_close(joint.variance, expected.variance, rtol=1e-7, atol=1e-12)
    both = slice(None)
    torch.testing.assert_close(joint.between(both, both), expected.between(both, both), rtol=0, atol=1e-11)


def test_the_joint_variance_stays_finite_when_one_point_is_observed_repeatedly(posterior, x):
    joint = Joint.of(posterior, x)
    for _ in range(50):
        joint = joint.observe(0)
    assert torch.isfinite(joint.variance).all()
    assert 0 <= float(joint.variance[0]) < joint.noise
