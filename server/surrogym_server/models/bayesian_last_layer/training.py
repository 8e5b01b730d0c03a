"""Training of the features by type-II maximum likelihood: gradients ascend the evidence of the last layer.

The hidden weights theta and the logarithms of the variances maximise, for each output,

    log p(y | theta, v, s^2) - 1/2 sum_j (theta_j - theta_0j)^2 / t_j + log p(v, s^2).

The evidence integrates over the last layer only. Alone it would let the thousand weights below fit the noise of a few
samples. So these have a normal prior of variances t around the random weights theta_0 with which they begin: few
samples leave the network nearly random, and many move it.

References: S. Ober, C. Rasmussen, M. van der Wilk, "The promises and pitfalls of deep kernel learning", UAI 2021; J.
Watson et al., "Latent derivative Bayesian last layer networks", AISTATS 2021; J. Harrison et al., "Variational Bayesian
last layers", ICLR 2024.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from surrogym_server.models.bayesian_last_layer.evidence import (
    Moments,
    left_out,
    log_evidence,
    log_evidence_of,
    posterior,
)
from surrogym_server.models.bayesian_last_layer.features import Features, polynomial
from surrogym_server.models.bayesian_last_layer.regression import Regression
from surrogym_server.tensors import in_rows

RATE, VARIANCE_RATE = 0.01, 0.03  # initial learning rates of weights and of variances; they decay to 0 by a cosine
LARGEST_BATCH = 256  # more samples are drawn from at random in each step
LEAST_NOISE = 1e-8  # variance, in those of an output
TYPICAL_NOISE = 1e-3  # median of the noise's prior, in the same unit
WIDE, WIDER = (
    1.5,
    3.0,
)  # deviations of the priors of logarithms: of the parts' variances and length scales, of the noise
PARTS = 3  # polynomial, units, waves
LENGTH, LENGTH_WIDTH = 2.0, 1.0  # median of the prior of length scales, in deviations of an input, and width of its log
WARM_SHARE = 3  # a warm start takes a third of the steps
LAST_STEPS = 100  # for the variances alone, with all samples
ROWS = 8_192  # samples at once


@dataclass(frozen=True)
class Training:
    """How a regression is trained.

    Attributes:
        members: number of networks of each output.
        units: of each hidden layer.
        waves: number of random Fourier features.
        steps: of gradient ascent.
        seed: of initial weights, waves and batches.
        freedom: variance of the prior of the hidden weights, in that of the random weights with which they begin.
    """

    members: int
    units: int
    waves: int
    steps: int
    seed: int
    freedom: float = 0.1


@dataclass(frozen=True)
class Fitted:
    """A regression in scales of 1, and what was trained, by name, for a warm start."""

    regression: Regression
    warm: dict[str, Tensor]


@dataclass(frozen=True)
class _Variables:
    """What is trained. Logarithms have normal priors."""

    hidden: tuple[Tensor, ...]
    parts: Tensor  # log of the variance of each part, (p, 3)
    lengths: Tensor  # log l (p, d)
    noise: Tensor  # log s^2 (p, 1)

    @property
    def named(self) -> dict[str, Tensor]:
        names = ("first", "first_bias", "second", "second_bias", "parts", "lengths", "noise")
        return dict(zip(names, (*self.hidden, self.parts, self.lengths, self.noise), strict=True))


def train(
    training: Training, x: Tensor, y: Tensor, *, quadratic: bool = False, warm: Mapping[str, Tensor] | None = None
) -> Fitted:
    """Fit features and last layers to inputs x (n, d) and standardised targets y (n, p).

    ``warm`` has what an earlier fit has trained. It is ignored if it has other shapes, and needs fewer steps.
    """
    generator = torch.Generator().manual_seed(training.seed)
    every = y.repeat(1, training.members)  # (n, K p)
    drawn = _Drawn.of(training, x.shape[1], every.shape[1], polynomial(x[:1], quadratic).shape[1], generator)
    found = _warmed(drawn.begin(), warm or {})
    steps = training.steps if found is None else math.ceil(training.steps / WARM_SHARE)
    at = drawn.begin() if found is None else found
    for tensor in at.named.values():
        tensor.requires_grad_()

    def objective() -> Tensor:
        rows = _batch(len(x), generator)
        phi = drawn.features(at)(x[rows], quadratic=quadratic)
        evidence = log_evidence(phi, every[rows].T, *drawn.variances(at))
        return -(evidence / phi.shape[-2] + drawn.log_prior(at) / len(x)).sum()

    _descend([(list(at.hidden), RATE), ([at.parts, at.lengths, at.noise], VARIANCE_RATE)], objective, steps)
    with torch.no_grad():
        features = drawn.features(at)
        moments = _moments(features, x, every, quadratic)
    if len(x) > LARGEST_BATCH:
        _descend([([at.parts, at.noise], VARIANCE_RATE)], lambda: _of_all(drawn, at, moments), LAST_STEPS)
    with torch.no_grad():
        regression = _regression(drawn, at, moments, y.shape[1])
        regression = replace(regression, left_out=_left_out(regression, x, y))
    return Fitted(regression, {name: in_rows(tensor) for name, tensor in at.named.items()})


def _regression(drawn: _Drawn, at: _Variables, moments: Moments, p: int) -> Regression:
    """The regression of p outputs, in scales of 1, without leave-one-out errors."""
    prior, noise = drawn.variances(at)
    weights, features = posterior(moments, prior, noise), drawn.features(at)
    by_member = (drawn.training.members, p)
    mean, root, s2, parts = (
        in_rows(values).reshape(*by_member, *values.shape[1:])
        for values in (weights.mean, weights.root, noise, at.parts.exp())
    )
    own = Features(*(in_rows(getattr(features, field.name)) for field in fields(Features)))
    return Regression(own, mean, root, s2, parts, noise.new_zeros(p), noise.new_ones(p), noise.new_zeros(p, 3))


def _left_out(regression: Regression, x: Tensor, y: Tensor) -> Tensor:
    """Leave-one-out error, and the shares within one and two deviations, of each output (p, 3)."""
    errors, variances = [], []
    for some, targets in zip(torch.split(x, ROWS), torch.split(y, ROWS), strict=True):
        error, variance = left_out(regression.phi(some), targets.T, regression.mean, regression.root, regression.noise)
        errors.append(error.mean(0))
        variances.append(variance.mean(0) + error.var(0, correction=0))
    error, deviation = torch.cat(errors, 1), torch.cat(variances, 1).sqrt()
    within = [(error.abs() <= times * deviation).double().mean(1) for times in (1, 2)]
    return torch.stack([error.square().mean(1).sqrt(), *within], 1)


@dataclass(frozen=True)
class _Drawn:
    """Random numbers of a training, and what follows from them and the variables."""

    training: Training
    anchors: tuple[Tensor, ...]
    spreads: tuple[float, ...]  # variances of the anchors
    polynomials: int  # number of features before the units
    frequencies: Tensor  # Omega (p, d, r)
    phases: Tensor  # (p, 1, r)

    @classmethod
    def of(cls, training: Training, d: int, p: int, polynomials: int, generator: torch.Generator) -> _Drawn:
        h, r = training.units, training.waves
        shapes, spreads = ((p, d, h), (p, 1, h), (p, h, h), (p, 1, h)), (1 / d, 1.0, 1 / h, 1.0)
        anchors = tuple(
            math.sqrt(t) * torch.randn(shape, generator=generator, dtype=torch.float64)
            for shape, t in zip(shapes, spreads, strict=True)
        )
        frequencies = torch.randn(p, d, r, generator=generator, dtype=torch.float64)
        phases = 2 * math.pi * torch.rand(p, 1, r, generator=generator, dtype=torch.float64)
        return cls(training, anchors, spreads, polynomials, frequencies, phases)

    def begin(self) -> _Variables:
        p, d, _ = self.frequencies.shape
        zero = self.phases.new_zeros
        noise = zero(p, 1) + math.log(TYPICAL_NOISE)
        return _Variables(tuple(a.clone() for a in self.anchors), zero(p, PARTS), zero(p, d) + math.log(LENGTH), noise)

    def features(self, at: _Variables) -> Features:
        first, first_bias, second, second_bias = at.hidden
        return Features(
            first, first_bias, second, second_bias, self.frequencies / at.lengths.exp()[..., None], self.phases
        )

    def variances(self, at: _Variables) -> tuple[Tensor, Tensor]:
        """v (p, k) and s^2 (p,)."""
        counts = torch.tensor([self.polynomials, self.training.units, self.training.waves])
        return at.parts.exp().repeat_interleave(counts, 1), at.noise[:, 0].exp() + LEAST_NOISE

    def log_prior(self, at: _Variables) -> Tensor:
        """Of all variables, without constants, (p,)."""
        total = (at.parts / WIDE).square().sum(1) + ((at.lengths - math.log(LENGTH)) / LENGTH_WIDTH).square().sum(1)
        total = total + ((at.noise - math.log(TYPICAL_NOISE)) / WIDER).square().sum(1)
        for weights, anchor, spread in zip(at.hidden, self.anchors, self.spreads, strict=True):
            total = total + ((weights - anchor).square() / (self.training.freedom * spread)).sum((1, 2))
        return -0.5 * total


def _of_all(drawn: _Drawn, at: _Variables, moments: Moments) -> Tensor:
    """Negative log evidence of all samples with priors of the variances, divided by their number."""
    evidence = log_evidence_of(moments, *drawn.variances(at)) + drawn.log_prior(at)
    return -evidence.sum() / moments.count


def _moments(features: Features, x: Tensor, y: Tensor, quadratic: bool) -> Moments:
    blocks = zip(torch.split(x, ROWS), torch.split(y, ROWS), strict=True)
    first, *rest = (Moments.of(features(a, quadratic=quadratic), b.T.contiguous()) for a, b in blocks)
    for moments in rest:
        first = first + moments
    return first


def _warmed(begun: _Variables, warm: Mapping[str, Tensor]) -> _Variables | None:
    """The variables of an earlier fit; None unless all of them have the right shapes and are finite."""
    names = begun.named
    if any(n not in warm or warm[n].shape != t.shape or not bool(warm[n].isfinite().all()) for n, t in names.items()):
        return None
    *hidden, parts, lengths, noise = (warm[name].clone() for name in names)
    return _Variables(tuple(hidden), parts, lengths, noise)


def _descend(groups: Sequence[tuple[list[Tensor], float]], objective: Callable[[], Tensor], steps: int) -> None:
    """Change variables in place by Adam. Each group has a learning rate of its own."""
    adam = torch.optim.Adam([{"params": tensors, "lr": rate} for tensors, rate in groups])
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, max(1, steps))
    for _ in range(steps):
        adam.zero_grad()
        objective().backward()  # type: ignore[no-untyped-call]
        adam.step()
        rate.step()


def _batch(count: int, generator: torch.Generator) -> Tensor | slice:
    """Rows for one step: all of them, or a random choice if there are many."""
    return slice(None) if count <= LARGEST_BATCH else torch.randint(count, (LARGEST_BATCH,), generator=generator)
