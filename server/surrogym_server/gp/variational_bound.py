"""Variational lower bound of the evidence of many points, through m inducing ones, and its gradient.

K_uu is the covariance matrix of the m inducing points Z, K_uf that of Z with the n points X, and K_ff that of X. With
Q = K_uf^T K_uu^-1 K_uf,

    F = log N(y | 0, Q + sigma_n^2 I) - tr(K_ff - Q) / (2 sigma_n^2) <= log p(y).

The trace counts what the inducing points leave unexplained. So hyperparameters that maximise F treat this part as
noise: sigma_n^2 grows by it. With all points as inducing ones F is the evidence. At the optimum of the variational
distribution predictions are those of the projected process, see ``gp.sparse``.

With L L^T = K_uu, V = L^-1 K_uf, S = V V^T + sigma_n^2 I, a = S^-1 V y and alpha = (y - V^T a) / sigma_n^2, F and its
gradient take O(n m^2), and

    dF/dK_uf = L^-T (a alpha^T + (I - sigma_n^2 S^-1) V / sigma_n^2),
    dF/dK_uu = -1/2 L^-T (a a^T + S / sigma_n^2 - 2 I + sigma_n^2 S^-1) L^-1.

Z are some of the points X, and do not change during a search. Points that the other inducing points explain least are
a good choice (``gp.sparse``), because log p(y) - F is at most tr(K_ff - Q) (1 + |y|^2 / sigma_n^2) / (2 sigma_n^2).

References: Titsias, "Variational learning of inducing variables in sparse Gaussian processes", AISTATS 2009; Burt,
Rasmussen, van der Wilk, "Convergence of sparse variational inference in Gaussian processes regression", JMLR 21 (2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # SciPy imports its submodules on first use, so a server that needs none of them starts sooner
import torch
from torch import Tensor

from surrogym_server.gp.fit import SHORTER
from surrogym_server.gp.kernel import Hyperparameters, Polynomial, Reflection
from surrogym_server.gp.parameters import Array, FitOptions, Parameters
from surrogym_server.gp.posterior import Posterior, condition
from surrogym_server.gp.search import blas, minimum
from surrogym_server.gp.sparse import condition_sparse, pivots
from surrogym_server.gp.subsets import SOME, spread

# Hyperparameters are searched for in two stages. Each is (greatest number of points, greatest number of iterations),
# and None stands for all points.
SEARCHES = ((2_000, 40), (None, 15))
# If the noise variance is above this share of the output's variance, errors that inducing points cause are negligible.
NOISY = 1e-4
PRECISE = 1e-4  # leave-one-out errors up to this share of the output's standard deviation count as precise
HARDLY = 0.3  # an input may be left out if its effect on the mean is below this share of the noise's standard deviation
TRIES = 6  # greatest number of searches for inputs that can be left out
JITTER = 1e-9  # added to the diagonal of K_uu, as a share of the points' mean prior variance


def fit_bound(
    x: Tensor, y: Tensor, options: FitOptions, theta: Array, inducing: int, reflection: Reflection | None = None
) -> Posterior:
    """Fit a process with inducing points to x (n, d) and y (n,), both standardised, by maximising the variational
    bound. Runs on the CPU.

    Args:
        theta: logarithms of hyperparameters, fitted to some of the points. One search starts at them, another at
            shorter length scales, both on at most 2,000 points. From the better result, a last search uses all points.
        inducing: greatest number of inducing points. If there are no more points than this, the posterior is exact.

    Raises:
        NumericalFailure: no jitter makes the covariance of the points positive definite.
    """
    shorter = theta.copy()
    shorter[: x.shape[1]] -= SHORTER
    shorter[-1] = Parameters(x.shape[1], options, reflection).default_start[-1]
    starts = [theta, shorter]
    with blas().limit(limits=1):
        for most, iterations in SEARCHES:
            rows = spread(len(y), len(y) if most is None else most)
            few = replace(options, max_iterations=iterations)
            fits = [_searched(x[rows], y[rows], few, start, inducing, reflection) for start in starts]
            starts = [min(fits, key=lambda pair: pair[0])[1]]
            if len(rows) == len(y):
                break
        hyper = Parameters(x.shape[1], options, reflection).hyper(starts[0])
        return condition(hyper, x, y) if len(y) <= inducing else condition_sparse(hyper, x, y, inducing)


def fit_through_few(
    x: Tensor, y: Tensor, options: FitOptions, theta: Array, reflection: Reflection | None = None
) -> Posterior | None:
    """Fit a process to points x (n, d), y (n,), both standardised, through fewer than ``SOME`` (400) of them as
    inducing points. Runs on the CPU.

    Args:
        theta: logarithms of hyperparameters, fitted to some of the points. If their noise is much larger than the
            errors that inducing points cause, a search that starts at theta also maximises the bound of all points.

    Returns:
        The posterior; None if inducing points would lose accuracy (see ``loses_nothing``), or if there are at most
        ``SOME`` points.
    """
    parameters = Parameters(x.shape[1], options, reflection)
    hyper = parameters.hyper(theta)
    if len(y) <= SOME or len(pivots(hyper, x, SOME)) == SOME:
        return None
    posteriors = [condition_sparse(hyper, x, y, SOME)]
    if is_noisy(hyper):
        with blas().limit(limits=1):
            few = replace(options, max_iterations=SEARCHES[-1][1])
            _, searched = _searched(x, y, few, theta, SOME, reflection)
        posteriors.append(condition_sparse(parameters.hyper(searched), x, y, SOME))
    whole = [posterior for posterior in posteriors if loses_nothing(posterior)]
    return max(whole, key=lambda posterior: posterior.left_out.log_density, default=None)


def loses_nothing(posterior: Posterior) -> bool:
    """Return whether a posterior is as accurate as one that uses all points without inducing points.

    A posterior without inducing points always is. One with inducing points counts as equally accurate if there are
    fewer than ``SOME`` (400) of them, and if either the noise is much larger than the errors that they cause or each
    point is predicted precisely from the other points.
    """
    if posterior.sparse is None:
        return True
    hidden = is_noisy(posterior.hyper) or posterior.left_out.error <= PRECISE
    return len(posterior.y) < SOME and hidden


def is_noisy(hyper: Hyperparameters) -> bool:
    """Return whether the noise is so large that the errors caused by inducing points are small compared with it."""
    return hyper.noise_variance > NOISY


@dataclass(frozen=True)
class Fewer:
    """Result of ``fewer_inputs``: a process that uses only some of the inputs."""

    mask: Tensor  # (d,) bool, true for the inputs that the process reads
    posterior: Posterior


def fewer_inputs(
    x: Tensor, y: Tensor, posterior: Posterior, options: FitOptions, inducing: int, may: Tensor, odds: float
) -> Fewer | None:
    """Leave out inputs that hardly change the mean of a process, if this increases the variational bound of the log
    evidence plus the log prior of the hyperparameters and of leaving out inputs. Runs on the CPU.

    The first of at most ``TRIES`` searches leaves out all inputs that hardly change the mean. If the bound does not
    increase without a set of inputs, each half of this set is tried, in addition to the inputs already left out.

    Args:
        x: inputs (n, d).
        y: targets (n,).
        posterior: the process with all inputs.
        inducing: greatest number of inducing points.
        may: (d,) bool, true for each input that may be left out. At least one input is kept.
        odds: by how much the log prior increases with each input that is left out.

    Returns:
        The process with fewer inputs, or None if all are kept.
    """
    effect = _effects(posterior, x[spread(len(y), SOME)])
    most = HARDLY * math.sqrt(posterior.hyper.noise_variance)
    ordered = [j for j in effect.argsort().tolist() if bool(may[j]) and float(effect[j]) < most]
    sets = [ordered[: x.shape[1] - 1]] if ordered else []
    with blas().limit(limits=1):
        inputs = _Inputs(x, y, replace(options, max_iterations=SEARCHES[-1][1]), inducing, posterior.hyper)
        for _ in range(TRIES):
            if not sets:
                break
            out = sets.pop()
            if not inputs.without(out, odds) and len(out) > 1:
                sets += [out[len(out) // 2 :], out[: len(out) // 2]]
        return None if bool(inputs.mask.all()) else inputs.process()


class _Inputs:
    """Search state of ``fewer_inputs``: the inputs that the process still reads, and the free parameters that maximise
    the bound for these inputs."""

    def __init__(self, x: Tensor, y: Tensor, options: FitOptions, inducing: int, hyper: Hyperparameters) -> None:
        self._x, self._y, self._options, self._inducing, self._mirror = x, y, options, inducing, hyper.reflection
        self._theta = Parameters(x.shape[1], options, hyper.reflection).theta(hyper)
        self._cost, _ = Bound(x, y, pivots(hyper, x, inducing), options, hyper.reflection)(self._theta)
        self.mask = torch.ones(x.shape[1], dtype=torch.bool)

    def without(self, out: Sequence[int], odds: float) -> bool:
        """Leave out the inputs with the indices ``out`` as well, if the bound then decreases by less than ``odds`` for
        each of them. Return whether they were left out."""
        mask = self.mask.index_fill(0, torch.tensor(out), value=False)
        mirror = self._reflection(mask)
        if mirror is not None and mirror.parity < 0 and bool((mirror.signs > 0).all()):
            # An odd function is zero everywhere if no remaining input changes its sign under the reflection.
            return False
        others = np.ones(len(self._theta) - int(self.mask.sum()), dtype=bool)
        start = self._theta[np.concatenate([mask[self.mask].numpy(), others])]
        cost, theta = _searched(self._x[:, mask], self._y, self._options, start, self._inducing, mirror)
        if cost - odds * len(out) >= self._cost:
            return False
        self._cost, self._theta, self.mask = cost, theta, mask
        return True

    def process(self) -> Fewer:
        x = self._x[:, self.mask]
        hyper = Parameters(x.shape[1], self._options, self._reflection(self.mask)).hyper(self._theta)
        return Fewer(self.mask, condition_sparse(hyper, x, self._y, self._inducing))

    def _reflection(self, mask: Tensor) -> Reflection | None:
        return None if self._mirror is None else replace(self._mirror, signs=self._mirror.signs[mask])


def _effects(posterior: Posterior, x: Tensor) -> Tensor:
    """Return the effect of each input on the mean, (d,): the root mean square change of the mean at x (m, d) if the
    values of this input are exchanged between rows."""
    mean, effects = posterior.mean(x), []
    for j in range(x.shape[1]):
        changed = x.clone()
        changed[:, j] = x[:, j].roll(1)
        effects.append((posterior.mean(changed) - mean).square().mean().sqrt())
    return torch.stack(effects)


def _searched(
    x: Tensor, y: Tensor, options: FitOptions, start: Array, inducing: int, reflection: Reflection | None
) -> tuple[float, Array]:
    """Minimise the negative bound over theta, the logarithms of hyperparameters, from ``start``, with inducing points
    that are chosen for ``start``. Return the least value and its theta."""
    parameters = Parameters(x.shape[1], options, reflection)
    clipped = np.clip(start, parameters.lower, parameters.upper)
    inducing_rows = pivots(parameters.hyper(clipped), x, inducing)
    return minimum(Bound(x, y, inducing_rows, options, reflection), clipped)


class Bound(Parameters):
    """Negative lower bound of the log evidence plus the log prior, and its gradient, as functions of theta, the
    logarithms of the hyperparameters."""

    def __init__(self, x: Tensor, y: Tensor, rows: Tensor, options: FitOptions, reflection: Reflection | None) -> None:
        """Prepare the bound for inputs x (n, d) and targets y (n,); ``rows`` (m,) are the row indices in x of the m
        inducing points."""
        super().__init__(x.shape[1], options, reflection)
        self.x, self.y, self.inducing_rows = x.numpy(), y.numpy(), rows.numpy()
        self.z = self.x[self.inducing_rows]
        self.parity = 0 if reflection is None else reflection.parity
        self.signs = np.ones(self.d) if reflection is None else reflection.signs.numpy()
        self._lines = Polynomial.of(1.0, 0.0, reflection, x)
        self._squares = Polynomial.of(0.0, 1.0, reflection, x)
        self._constant = 0.5 * len(y) * math.log(2 * math.pi) + self.prior_constant

    def __call__(self, theta: Array) -> tuple[float, Array]:
        """Return the negative bound with priors at theta, and its gradient.

        If a matrix has no Cholesky factor in float64, the value is 1e10, so that the line search tries a shorter step.
        """
        covariances = self._covariances(theta)
        k, noise = covariances.k, self.values(theta)[-1]
        n, m, prior = len(self.y), len(self.z), float(covariances.diagonal.sum())
        inner = k[:, self.inducing_rows].copy()
        inner.flat[:: m + 1] += JITTER * prior / n
        if (lower := _factor(inner)) is None:
            return 1e10, np.zeros_like(theta)
        v = _solve_lower(lower, k)  # V = L^-1 K_uf in the module's docstring
        square = v @ v.T
        s = square.copy()
        s.flat[:: m + 1] += noise
        if (root := _factor(s)) is None:
            return 1e10, np.zeros_like(theta)
        # a = S^-1 V y in the module's docstring.
        weights = scipy.linalg.cho_solve((root, True), v @ self.y, check_finite=False)
        inverse = scipy.linalg.cho_solve((root, True), np.eye(m), check_finite=False)
        alpha = (self.y - weights @ v) / noise
        left = prior - float(square.trace())
        logs = (n - m) * math.log(noise) + 2 * float(np.log(root.diagonal()).sum())
        z = self.standardised(theta)
        value = 0.5 * (logs + self.y @ alpha + left / noise + z @ z) + self._constant

        back = scipy.linalg.solve_triangular(lower, np.eye(m), lower=True, trans=1, check_finite=False)  # back = L^-T
        outer = (back @ (np.eye(m) / noise - inverse)) @ v
        outer += np.outer(back @ weights, alpha)
        within = np.outer(weights, weights) + s / noise - 2 * np.eye(m) + noise * inverse
        within = -0.5 * back @ within @ back.T
        outer[:, self.inducing_rows] += within
        # Derivative of the bound with respect to each diagonal entry of K_ff.
        each = -0.5 / noise + JITTER * float(within.trace()) / n
        gradient = self._gradient(theta, covariances, outer, each)
        freedom = n - m + noise * float(inverse.trace())
        gradient[-1] = 0.5 * (noise * float(alpha @ alpha) - freedom + left / noise)
        return float(value), z / self.prior[:, 1] - gradient

    def _covariances(self, theta: Array) -> _Covariances:
        lengthscale, signal, linear, quadratic, _ = self.values(theta)
        a, b = self.z / lengthscale, self.x / lengthscale
        smooth = [signal * _exponential(a, b)]
        diagonal = np.full(len(b), signal)
        if self.parity:
            smooth.append(self.parity * signal * _exponential(a, b * self.signs))
            mirrored = self.parity * signal * np.exp(np.square(b) @ (self.signs - 1))
            diagonal = diagonal + mirrored
        else:
            mirrored = np.zeros(0)
        k = smooth[0] + smooth[1] if self.parity else smooth[0].copy()
        if linear:
            k += linear * self._polynomial(self._lines)
            diagonal = diagonal + linear * self._lines.diagonal(torch.from_numpy(self.x)).numpy()
        if quadratic:
            k += quadratic * self._polynomial(self._squares)
            diagonal = diagonal + quadratic * self._squares.diagonal(torch.from_numpy(self.x)).numpy()
        return _Covariances(k, smooth, diagonal, mirrored)

    def _polynomial(self, part: Polynomial) -> Array:
        part_of_kernel: Array = part(torch.from_numpy(self.z), torch.from_numpy(self.x)).numpy()
        return part_of_kernel

    def _gradient(self, theta: Array, covariances: _Covariances, outer: Array, each: float) -> Array:
        """Return the gradient of the bound (without priors) with respect to theta, by the chain rule. The entry of the
        noise stays 0.

        Args:
            theta: free parameters.
            covariances: the covariances at theta.
            outer: gradient of the bound with respect to K_uf, (m, n). It includes that with respect to K_uu, because
                inducing points are some of the points.
            each: derivative of the bound with respect to each entry of K_ff's diagonal, which is the same for all.
        """
        lengthscale, signal, linear, quadratic, _ = self.values(theta)
        gradient, n = np.zeros_like(theta), len(self.y)
        gradient[self.d] = each * (n * signal + float(covariances.mirrored.sum()))
        for smooth, signs in zip(covariances.smooth, (np.ones(self.d), self.signs), strict=False):
            weighted, x = outer * smooth, self.x * signs
            gradient[self.d] += weighted.sum()
            squared = weighted.sum(1) @ np.square(self.z) + weighted.sum(0) @ np.square(x)
            gradient[: self.d] += (squared - 2 * ((weighted @ x) * self.z).sum(0)) / lengthscale**2
        if self.parity:
            slope = -2 * (self.signs - 1) / lengthscale**2
            gradient[: self.d] += each * slope * (covariances.mirrored @ np.square(self.x))
        x, place = torch.from_numpy(self.x), self.d + 1
        for variance, part in ((linear, self._lines), (quadratic, self._squares)):
            if variance:
                own = (outer * self._polynomial(part)).sum() + each * float(part.diagonal(x).sum())
                gradient[place] = variance * own
                place += 1
        return gradient


@dataclass(frozen=True)
class _Covariances:
    k: Array  # (m, n) covariances of the inducing points with all points
    # Squared-exponential part of k, (m, n); with a reflection also the part that comes from mirror images of points.
    smooth: list[Array]
    diagonal: Array  # (n,) prior variance of each point
    # (n,) part of each prior variance that comes from the point's own mirror image; empty without a reflection.
    mirrored: Array


def _exponential(a: Array, b: Array) -> Array:
    """Return exp(-1/2 |a_i - b_j|^2) for inputs a (m, d) and b (n, d), shape (m, n)."""
    k = a @ b.T
    k -= 0.5 * np.square(a).sum(1)[:, None]
    k -= 0.5 * np.square(b).sum(1)
    result: Array = np.exp(k, out=k)
    return result


def _factor(matrix: Array) -> Array | None:
    """Return the lower Cholesky factor (m, m) of a symmetric matrix (m, m); None if it is not positive definite."""
    lower, info = scipy.linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    return None if info else np.ascontiguousarray(lower)


def _solve_lower(lower: Array, k: Array) -> Array:
    """Return L^-1 k for a lower triangular L (m, m) and k (m, n)."""
    solution: Array = scipy.linalg.blas.dtrsm(1.0, lower.T, k.T, side=1, lower=0).T
    return solution
