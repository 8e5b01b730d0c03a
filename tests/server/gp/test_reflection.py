"""Processes of odd and even functions: what they are, what their mirror images are worth, and that nothing else can
be learned by them."""

from dataclasses import replace

import pytest
import torch

from surrogym_server.gp import FitOptions, Hyperparameters, Reflection, condition, fit
from surrogym_server.gp.kernel import covariance, variance

SIGNS = torch.tensor([-1.0, 1.0], dtype=torch.float64)


@pytest.fixture(params=[1, -1], ids=["even", "odd"])
def reflected(request: pytest.FixtureRequest) -> Hyperparameters:
    lengthscale = torch.tensor([0.8, 1.7], dtype=torch.float64)
    return Hyperparameters(lengthscale, 1.6, 0.7, 0.3, 1e-3, Reflection(SIGNS, request.param))


def points(rng, n: int) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=(n, 2)))


def even(x: torch.Tensor) -> torch.Tensor:
    return torch.cos(2 * x[:, 0]) + x[:, 1] + x[:, 0].square()


def odd(x: torch.Tensor) -> torch.Tensor:
    return torch.sin(2 * x[:, 0]) * (1 + x[:, 1]) + 0.3 * x[:, 0]


def test_the_kernel_of_an_odd_or_even_process_equals_its_symmetrised_plain_kernel(reflected, rng):
    """Of f(x) + p f(s x) over the root of 2, f a plain process, with the polynomial parts at half of their variance."""
    a, b, parity = points(rng, 6), points(rng, 5), reflected.reflection.parity
    plain = replace(reflected, reflection=None, linear_variance=0.35, quadratic_variance=0.15)
    expected = covariance(plain, a, b) + parity * covariance(plain, a, b * SIGNS)
    torch.testing.assert_close(covariance(reflected, a, b), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(variance(reflected, a), covariance(reflected, a, a).diagonal())


def test_an_odd_or_even_process_predicts_like_a_plain_one_with_mirrored_points(reflected, rng):
    """Each observed with twice the noise, by a process of half of the variances: the two errors average."""
    x, at, parity = points(rng, 9), points(rng, 20), reflected.reflection.parity
    y = even(x) if parity > 0 else odd(x)
    plain = replace(reflected, reflection=None, noise_variance=2e-3, signal_variance=3.2)
    doubled = condition(plain, torch.cat([x, x * SIGNS]), torch.cat([y, parity * y]))
    torch.testing.assert_close(condition(reflected, x, y).mean(at), doubled.mean(at), rtol=1e-9, atol=1e-9)


def test_predictions_of_an_odd_or_even_process_are_odd_or_even(reflected, rng):
    x, at, parity = points(rng, 9), points(rng, 20), reflected.reflection.parity
    mean, latent = condition(reflected, x, even(x)).mean_and_variance(at)
    mirrored, same = condition(reflected, x, even(x)).mean_and_variance(at * SIGNS)
    torch.testing.assert_close(mirrored, parity * mean, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(same, latent, rtol=1e-8, atol=1e-10)


def test_an_odd_process_is_zero_with_certainty_on_the_mirror_plane(rng):
    hyper = Hyperparameters(torch.ones(2, dtype=torch.float64), 1.0, 0.5, 0.5, 1e-4, Reflection(SIGNS, -1))
    at = points(rng, 7) * torch.tensor([0.0, 1.0], dtype=torch.float64)
    mean, latent = condition(hyper, points(rng, 3), torch.ones(3, dtype=torch.float64)).mean_and_variance(at)
    torch.testing.assert_close(mean, torch.zeros_like(mean), rtol=0, atol=1e-12)
    torch.testing.assert_close(latent, torch.zeros_like(latent), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("function", "parity"), [(even, 1), (odd, -1)], ids=["even", "odd"])
def test_the_marginal_likelihood_selects_the_parity_of_a_function(rng, function, parity):
    x = points(rng, 20)
    y = function(x)
    scores = {p: fit(x, y, FitOptions(), reflection=Reflection(SIGNS, p)).score for p in (1, -1)}
    scores[0] = fit(x, y, FitOptions()).score
    assert max(scores, key=lambda p: scores[p]) == parity


def test_an_odd_process_predicts_an_odd_function_better_than_a_plain_process(rng):
    """Learned by its parity from n points a function is known better than without from n."""
    x, at = points(rng, 16), points(rng, 200)
    error = {}
    for reflection in (None, Reflection(SIGNS, -1)):
        fitted = fit(x, odd(x), FitOptions(), reflection=reflection)
        error[reflection is None] = float((fitted.posterior.mean(at) - odd(at)).square().mean().sqrt())
    assert error[False] < 0.5 * error[True]
