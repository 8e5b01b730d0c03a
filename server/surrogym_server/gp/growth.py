"""Functions that change faster the larger an input is, such as rates of reaction over the temperature.

    F(z) = a(z) G(w(z)),  w_j(z) = (e^(g_j z_j) - 1) / g_j,  a(z) = prod_j e^(g_j z_j) = prod_j (1 + g_j w_j(z))

z are standardised inputs, G is an ordinary process, and g (d,) are the rates: at g = 0, F is G. A stationary process
has one length scale and one amplitude for all places, so a function that is steep in one place seems rough everywhere.
F may be steep in one place and smooth in another. An exponential is the simplest such law, and near a temperature it is
the law of Arrhenius.

Since a is known once g is, fitting F to targets t at z is fitting G to y = t / a(z) at w(z), and

    log p(t) = log p(y) - sum_i log a(z_i).

The noise of F is that of G times a(z). All samples have |z_j| <= ``EDGE``. Beyond, w is a line on the steep side and
constant on the flat side (``tensors.bend``), because an exponential would overflow far away. References: P. Sampson,
P. Guttorp (1992), JASA 87 (stationary after a deformation of the inputs); C. Paciorek, M. Schervish (2006),
Environmetrics 17 (non-stationary covariances).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.gp.fit import Fitted
from surrogym_server.gp.parameters import FitOptions
from surrogym_server.gp.posterior import condition
from surrogym_server.gp.search import Evidence, blas, minimum
from surrogym_server.tensors import EDGE, STEEPEST, amplitude, bend

# Prior standard deviation of a rate g_j: how fast the output's changes grow along input j (deviation near 1).
PRIOR = 1.0
FLAT = 1e-3  # a rate g_j (growth of the output's changes along input j) of smaller absolute value is set to 0

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Growing:
    """Result of fitting F, a function that changes faster the larger an input is (see the module): an ordinary process
    G, and the rate of each input."""

    fitted: Fitted  # fit of the process G; its `score` is the log evidence of F, and its `theta` ends with the rates
    rates: tuple[float, ...]  # (d,) rate g_j of each input; 0 if F does not change faster the larger the input is


def fit_growing(z: Tensor, t: Tensor, may: Tensor, options: FitOptions, starts: Sequence[Array]) -> Growing:
    """Fit F, a function that changes faster the larger an input is (see the module), to inputs z (n, d) and targets t
    (n,), both standardised. Runs on the CPU.

    Args:
        may: (d,) bool, true for each input that may have a rate. The absolute values of these inputs are at most
            ``EDGE``.
        options: options of the fit without rates; they must have no quadratic part.
        starts: logarithms of hyperparameters at which searches start, from fits without rates, or followed by the
            rates, from earlier fits with rates.

    Raises:
        NumericalFailure: no jitter makes the covariance of the points positive definite.
        ValueError: an input that may have a rate lies beyond ``EDGE``, or the options have a quadratic part.
    """
    if bool((z[:, may].abs() > EDGE).any()):
        raise ValueError(
            f"expected absolute values of at most {EDGE} in each input whose entry of `may` is true, "
            f"got {float(z[:, may].abs().max()):g}; set `may` to false for inputs with larger values"
        )
    objective = _GrowingObjective(z, t, may, options)
    padded = [np.concatenate([start, np.zeros(objective.size - len(start))]) for start in starts]
    with blas().limit(limits=1):
        value, theta = min((minimum(objective, start) for start in padded), key=lambda pair: pair[0])
    rates = torch.from_numpy(objective.rates(theta))
    rates = torch.where(rates.abs() < FLAT, 0.0, rates)
    w = bend(z, rates)
    posterior = condition(objective.plain(theta)[0].hyper(theta[: objective.inner]), w, t / amplitude(w, rates))
    return Growing(Fitted(posterior, -value, theta), tuple(rates.tolist()))


class _GrowingObjective:
    """Negative log evidence of F, a function that changes faster the larger an input is (see the module), priors
    included. It depends on theta = [theta of the process G, rates of the inputs that may have one]."""

    def __init__(self, z: Tensor, t: Tensor, may: Tensor, options: FitOptions) -> None:
        if options.quadratic:
            raise ValueError("expected fit options with quadratic=False, as growth rates need it, got quadratic=True")
        self.options, self._z, self._t, self._may = options, z.numpy(), t.numpy(), may.numpy()
        plain = Evidence(z, t, options, None)
        self.inner, count = len(plain.default_start), int(self._may.sum())
        self.size = self.inner + count
        self.lower = np.concatenate([plain.lower, np.full(count, -STEEPEST)])
        self.upper = np.concatenate([plain.upper, np.full(count, STEEPEST)])

    def rates(self, theta: Array) -> Array:
        """Return the rates of all inputs, (d,); inputs that may not have a rate have 0."""
        rates = np.zeros(self._z.shape[1])
        rates[self._may] = theta[self.inner :]
        return rates

    def plain(self, theta: Array) -> tuple[Evidence, Array]:
        """Apply the rates in theta to inputs and targets. Return the negative log evidence of the process G, an object
        that is called with the hyperparameters of G, and the derivatives of each input w_j of G with respect to its
        rate, (n, d)."""
        rates, z = self.rates(theta), self._z
        small = np.abs(rates) < FLAT
        safe = np.where(small, 1.0, rates)
        bent = np.where(small, z + 0.5 * rates * z**2, np.expm1(safe * z) / safe)
        slope = np.where(small, 0.5 * z**2 + rates * z**3 / 3, (z * np.exp(safe * z) - bent) / safe)
        y = self._t * np.exp(-(z @ rates))
        return Evidence(torch.from_numpy(bent), torch.from_numpy(y), self.options, None), slope

    def __call__(self, theta: Array) -> tuple[float, Array]:
        objective, slope = self.plain(theta)
        rates, z = self.rates(theta), self._z
        inner = objective.evaluated(theta[: self.inner])
        if inner is None:
            return 1e10, np.zeros_like(theta)
        over = objective.over_inputs(theta[: self.inner], inner)
        of_rates = (over * slope).sum(0) + z.sum(0) - (inner.weights * objective.y) @ z
        own = rates / PRIOR**2
        value = inner.value + float(z.sum(0) @ rates) + 0.5 * float(rates @ own)
        return value, np.concatenate([inner.slopes, (of_rates + own)[self._may]])
