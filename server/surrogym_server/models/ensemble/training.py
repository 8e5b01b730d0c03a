"""Training of anchored networks: each is regularised towards the random weights (anchor) with which it started.

The weights w of network k minimise, over n samples (x_i, y_i) of standardised inputs and outputs,

    1/n sum_i |y_i - f_k(x_i)|^2 + sigma^2 / n sum_j (w_j - w_kj)^2 / v_j,

with anchors w_k drawn from a normal prior of variances v, and sigma the standard deviation of the noise. For a linear
model the K minima are samples of the posterior; for networks they are so approximately. Far from samples the networks
differ as their anchors do.

With learned noise, each f_k has a second network g_k for the log variance of a step, and 1/2 (log s + |y - f|^2 / s)
with s = exp(g_k(x)) replaces the squared error. So the mean need not follow steps that it can't predict, such as those
near a contact, and their errors count as noise. The weight of the second term stays the same.

With 0 < beta <= 1, each step's loss is weighted by s^beta, through which no gradient passes. With beta = 1 the mean has
the gradient of the squared error, and also learns steps that the noise could explain.

References: T. Pearce, F. Leibfried, A. Brintrup, "Uncertainty in neural networks: approximately Bayesian ensembling",
AISTATS 2020, eq. 9; B. Lakshminarayanan, A. Pritzel, C. Blundell, "Simple and scalable predictive uncertainty
estimation using deep ensembles", NeurIPS 2017, eq. 1; M. Seitzer, A. Tavakoli, D. Antic, G. Martius, "On the pitfalls
of heteroscedastic uncertainty estimation with probabilistic neural networks", ICLR 2022, eq. 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from surrogym_server.models.ensemble.networks import Networks, basis, bounded, nonlinear
from surrogym_server.tensors import in_rows

# Standard deviation sigma of the noise in the weight sigma^2 / n of the regularisation, as a share of an output's
# standard deviation.
NOISE = 0.01
RIDGE = 1e-3  # ridge penalty in the regression that gives the initial weights of the linear part
RATE = 0.01  # initial learning rate; it decays to 0 by a cosine
LARGEST_BATCH = 512
# Noise that networks predict before training, as a share of an output's standard deviation. If it begins at 0.05,
# training fails near contacts, where the motion changes suddenly.
NOISE_BEGINS = math.exp(-1.5)
Loss = Callable[[Tensor, Tensor], Tensor]  # arguments: predictions of K networks (K, m, p), and targets (m, p)


@dataclass(frozen=True)
class Training:
    """Settings of the networks and of their training, which ``NetworkEnsembles`` explains."""

    members: int
    units: int
    steps: int
    seed: int
    beta: float


def squared_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the squared error of predictions (K, m, p) of targets (m, p), summed over K networks and p outputs and
    averaged over m samples."""
    return (predicted - target).square().mean(1).sum()


def cross_entropy(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the cross entropy of logits (K, m, p) and labels 0 or 1 (m, p), summed over K networks and p outputs and
    averaged over m samples."""
    each = binary_cross_entropy_with_logits(predicted, target.expand_as(predicted), reduction="none")
    total: Tensor = each.mean(1).sum()
    return total


def train(training: Training, x: Tensor, y: Tensor, loss: Loss, *, quadratic: bool = False) -> Networks:
    """Fit networks with the settings ``training`` to inputs x (n, d) and targets y (n, p) by minimising ``loss``. If
    ``quadratic``, their linear part also reads the squares of the inputs."""
    generator = torch.Generator().manual_seed(training.seed)
    anchors, variances = _priors(training, x.shape[1], y.shape[1], generator)
    linear = basis(x, quadratic)
    skip = _ridge(linear, y - nonlinear(x, anchors)).requires_grad_()
    hidden = tuple(anchor.clone().requires_grad_() for anchor in anchors)

    def objective() -> Tensor:
        rows = _batch(len(x), generator)
        pull = [((w - a).square() / v).sum() for w, a, v in zip(hidden, anchors, variances, strict=True)]
        error = loss(linear[rows] @ skip + nonlinear(x[rows], hidden), y[rows])
        return error + NOISE**2 / len(x) * torch.stack(pull).sum()

    _descend((skip, *hidden), objective, training.steps)
    return Networks(*map(in_rows, (skip, *hidden)))


def train_with_noise(training: Training, x: Tensor, y: Tensor) -> tuple[Networks, Networks]:
    """Fit networks to inputs x (n, d) and targets y (n, p), together with networks of the log variance of the noise.
    Return the former and the latter."""
    generator = torch.Generator().manual_seed(training.seed)
    anchors, variances = _priors(training, x.shape[1], y.shape[1], generator)
    drawn, _ = _priors(training, x.shape[1], y.shape[1], generator)
    linear = basis(x, quadratic=False)
    skip = _ridge(linear, y - nonlinear(x, anchors)).requires_grad_()
    hidden = tuple(anchor.clone().requires_grad_() for anchor in anchors)
    log_noise = x.new_full((training.members, 1, y.shape[1]), 2 * math.log(NOISE_BEGINS)).requires_grad_()
    noisy = tuple(weights.requires_grad_() for weights in (*drawn[:-1], torch.zeros_like(drawn[-1])))

    def objective() -> Tensor:
        rows = _batch(len(x), generator)
        mean = linear[rows] @ skip + nonlinear(x[rows], hidden)
        log_variance = bounded(log_noise + nonlinear(x[rows], noisy))
        pull = [((w - a).square() / v).sum() for w, a, v in zip(hidden, anchors, variances, strict=True)]
        return _unlikely(mean, log_variance, y[rows], training.beta) + NOISE**2 / len(x) * torch.stack(pull).sum()

    _descend((skip, *hidden, log_noise, *noisy), objective, training.steps)
    # The linear part of the networks of the noise is a constant, so its weights of the inputs are 0.
    constant = torch.cat([log_noise, log_noise.new_zeros(len(log_noise), x.shape[1], y.shape[1])], 1)
    return Networks(*map(in_rows, (skip, *hidden))), Networks(*map(in_rows, (constant, *noisy)))


def _unlikely(mean: Tensor, log_variance: Tensor, target: Tensor, beta: float) -> Tensor:
    """Return the negative log likelihood of targets (m, p) up to a constant, as a loss.

    It is summed over networks (members) and outputs, and averaged over samples. The term of each sample is weighted by
    its predicted variance to the power of ``beta``. ``mean`` and ``log_variance`` are the predictions of all K
    networks, (K, m, p).
    """
    each = 0.5 * (log_variance + (target - mean).square() * (-log_variance).exp())
    return (each * (beta * log_variance.detach()).exp()).mean(1).sum()


def _descend(weights: Sequence[Tensor], objective: Callable[[], Tensor], steps: int) -> None:
    """Minimise the objective by ``steps`` steps of Adam, which change the weights in place."""
    adam = torch.optim.Adam(weights, lr=RATE)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    for _ in range(steps):
        adam.zero_grad()
        objective().backward()  # type: ignore[no-untyped-call]
        adam.step()
        rate.step()


def _batch(count: int, generator: torch.Generator) -> Tensor | slice:
    """Return the rows of samples for one step of gradient descent: all ``count`` rows, or a random selection if there
    are many."""
    return slice(None) if count <= LARGEST_BATCH else torch.randint(count, (LARGEST_BATCH,), generator=generator)


def _priors(
    training: Training, d: int, p: int, generator: torch.Generator
) -> tuple[tuple[Tensor, ...], tuple[float, ...]]:
    """Return random initial weights of the hidden layers for d inputs and p outputs, and their prior variances."""
    h, k = training.units, training.members
    shapes = ((k, d, h), (k, 1, h), (k, h, h), (k, 1, h), (k, h, p))
    variances = (1 / d, 1.0, 1 / h, 1.0, 1 / h)
    numbers = (torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes)
    return tuple(math.sqrt(v) * weights for weights, v in zip(numbers, variances, strict=True)), variances


def _ridge(b: Tensor, target: Tensor) -> Tensor:
    """Return initial weights (K, s, p) of the linear part by ridge regression of targets (K, n, p) on b (n, s)."""
    gram = b.T @ b + RIDGE * torch.eye(b.shape[1], dtype=b.dtype)
    weights: Tensor = torch.linalg.solve(gram, b.T @ target)
    return weights
