"""The posterior of a simulator's parameters beside its discrepancy: what the simulator gets wrong with any parameters.

Each coordinate's errors are those of the parameters, linear near the optimum, plus a Gaussian process of the state and
the action, plus independent noise (M. C. Kennedy, A. O'Hagan, "Bayesian calibration of computer models", JRSS B 63,
2001). The process can imitate a parameter's effect, so that more steps do not tell them apart. So the intervals count
the part of the errors that steps share as one of a cluster (L. Kish, "Survey Sampling", 1965, section 5.4).

Shapes: n steps, M coordinates that change, I inputs, P parameters, each scaled to [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NUDGE = 1e-5  # step size of numerical derivatives, as a share of a parameter's range
FINEST = 1e-7  # smallest stated standard deviation of a parameter, as a share of its range: the fit's own precision
SMALLEST = 1e-9  # an error below this share of the coordinates' changes counts as rounding
LEAST_SHARE = 1e-3  # coordinates whose errors are below this share of the largest error all get the same weight
MOST_STEPS = 200  # largest number of steps, at equal distances among all, on which the process is fitted
ROUNDS = 3  # Gauss-Newton steps
FARTHEST = 0.3  # largest change of a parameter in a Gauss-Newton step
# Errors count as independent unless the process is more probable by this factor's natural logarithm.
EVIDENCE = 3.0
# Starts, bounds, and modes and standard deviations of the prior, for the logarithms of the process's amplitude, of its
# length scale, and of the noise. Amplitude and noise are multiples of the errors' size; the length scale is one of the
# root mean square distance along an input.
STARTS = ((0.0, 0.5, -2.0), (-2.0, 0.5, 0.0))
BOUNDS = ((-4.0, 5.0), (0.0, 3.0), (-6.0, 3.0))
NOISE_ALONE = ((-4.0, 0.5, 0.0), ((-4.0, -4.0), (0.5, 0.5), (-6.0, 3.0)))  # a start and bounds without a process
FEWEST_LEFT = 8  # with fewer steps beyond the number of parameters, all errors count as shared
MODES, DEVIATIONS = np.array([0.0, 0.5, -2.0]), np.array([2.0, 1.0, 2.0])


@dataclass(frozen=True)
class Posterior:
    """The parameters that are most probable, ``x`` (P,), their standard ``deviations`` (P,), and the degrees of freedom
    of Student's t distribution, by which the interval of each is found."""

    x: Array
    deviations: Array
    degrees: float

    def interval(self, confidence: float) -> tuple[Array, Array]:
        """Return the ends (P,) of the interval that holds a parameter with this probability."""
        from scipy.stats import t

        reach = self.deviations * t.ppf(0.5 + confidence / 2, self.degrees)
        return self.x - reach, self.x + reach


@dataclass(frozen=True)
class _Process:
    """Covariance (n, n) of a coordinate's errors, and the share of their variance that steps share."""

    covariance: Array
    shared: float


def posterior(errors: Callable[[Array], Array], inputs: Array, own: Array, within: float, x: Array) -> Posterior:
    """Compute the posterior of parameters near ``x`` (P,).

    Args:
        errors: errors (n, M) of the simulator's steps for parameters (P,).
        inputs: what the steps depend on (n, I), each input in its standard deviations.
        own: the mean (P,) of the prior of the parameters.
        within: the standard deviation of this prior.
        x: the parameters to begin with.
    """
    chosen = np.unique(np.linspace(0, len(inputs) - 1, min(len(inputs), MOST_STEPS)).round().astype(int))
    apart = ((inputs[chosen, None] - inputs[None, chosen]) ** 2).mean(-1)
    off, jacobian = _linear(errors, x)
    # the likelihood does not depend on the parameters' part of the errors, so that one fit serves for all rounds
    processes = [_process(off[chosen, m], jacobian[chosen, m], apart) for m in range(off.shape[1])]
    # Square roots of the precisions, because some parameters may only be determined as a ratio, within rounding errors.
    prior = np.eye(len(x)) / within
    roots = [np.linalg.cholesky(process.covariance) for process in processes]
    for _ in range(ROUNDS):
        whitened = [np.linalg.solve(root, np.c_[jacobian[chosen, m], -off[chosen, m]]) for m, root in enumerate(roots)]
        rows = np.concatenate([*whitened, np.c_[prior, (own - x) / within]])
        change = np.clip(np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0], -FARTHEST, FARTHEST)
        x = np.clip(x + change, 0, 1)
        off, jacobian = _linear(errors, x)
    degrees = max(1.0, len(off) - len(x) / off.shape[1])
    sizes = (off**2).sum(0) / degrees
    sizes = np.maximum(sizes, max(SMALLEST**2, LEAST_SHARE**2 * sizes.max()))
    alike = 1 + (len(off) - 1) * np.array([process.shared for process in processes])
    scaled = jacobian / np.sqrt(sizes * alike)[:, None]
    root = np.linalg.qr(np.concatenate([scaled.reshape(-1, len(x)), prior]), mode="r")
    deviations = np.sqrt((np.linalg.inv(root) ** 2).sum(1))
    return Posterior(x, np.maximum(deviations, FINEST), degrees)


def _linear(errors: Callable[[Array], Array], x: Array) -> tuple[Array, Array]:
    """Return the errors (n, M) at ``x`` (P,), and their derivatives (n, M, P)."""
    ends = [np.clip([x - NUDGE * axis, x + NUDGE * axis], 0, 1) for axis in np.eye(len(x))]
    slopes = [(errors(end) - errors(begin)) / (end - begin).sum() for begin, end in ends]
    return errors(x), np.stack(slopes, -1)


def _process(error: Array, by: Array, apart: Array) -> _Process:
    """Fit the process to a coordinate's errors (n,), whose derivatives are ``by`` (n, P), by restricted likelihood.

    Only the part of the errors that no parameter changes counts. ``apart`` (n, n) are the steps' squared distances.
    """
    from scipy.linalg import cho_factor, cho_solve
    from scipy.optimize import minimize

    size, (count, parameters) = max(SMALLEST, float(np.sqrt((error**2).mean()))), by.shape
    if count - parameters < FEWEST_LEFT:
        return _Process(size**2 * np.eye(count), 1.0)
    unchanged = np.linalg.qr(by, mode="complete")[0][:, parameters:]
    rest = unchanged.T @ error / size

    def covariance(logarithms: Array) -> Array:
        amplitude, length, noise = np.exp(logarithms)
        return np.asarray(amplitude**2 * np.exp(-apart / (2 * length**2)) + noise**2 * np.eye(count))

    def improbability(logarithms: Array) -> float:
        factor = cho_factor(unchanged.T @ covariance(logarithms) @ unchanged, lower=True)
        density = rest @ cho_solve(factor, rest) / 2 + np.log(np.diag(factor[0])).sum()
        return float(density + (((logarithms - MODES) / DEVIATIONS) ** 2).sum() / 2)

    def fitted(start: tuple[float, ...], bounds: tuple[tuple[float, float], ...]) -> Any:
        return minimize(improbability, np.array(start), method="L-BFGS-B", bounds=bounds)

    best = min((fitted(start, BOUNDS) for start in STARTS), key=lambda fit: float(fit.fun))
    alone = fitted(*NOISE_ALONE)
    if alone.fun - best.fun < EVIDENCE:
        return _Process(size**2 * covariance(alone.x), 0.0)
    amplitude, _, noise = np.exp(2 * best.x)
    return _Process(size**2 * covariance(best.x), float(amplitude / (amplitude + noise)))
