"""Prediction of all outputs of a model at the same inputs, by a few matrix products.

The exponent of the squared exponential is linear in z(x) = [x, x^2, 1] (elementwise square):

    -1/2 sum_j (x_j - X_ij)^2 / l_j^2 = sum_j x_j X_ij / l_j^2 - 1/2 sum_j x_j^2 / l_j^2 - 1/2 sum_j X_ij^2 / l_j^2,

so exp(z A) are the squared exponentials of x with the points X_i of all outputs. The polynomial covariances z R are
linear in z as well, so their part of the mean is z Q with Q = R beta, and all means are exp(z A) W + z Q.
The variance, k(x, x) - |L^-1 k(X, x)|^2, takes a triangular solve and is computed for the requested outputs only.
A process with a reflection has the columns of its points and then those of their mirror images.

The products lose digits that differences keep: |error of the exponent| <= (2 d + 2) eps (|x| + |X_i|)^2 / 2, for inputs
divided by the length scales. ``_error_bounds`` bounds the errors of mean and variance that result. If a bound is too
large, the exponent is computed from differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters, to_mirror
from surrogym_server.gp.pathwise import Pathwise
from surrogym_server.gp.posterior import Posterior
from surrogym_server.tensors import CPU, GPU_BLOCK, in_blocks

BLOCK = 262_144  # greatest number of covariances computed at once, so that they fit into the processor's cache
MIN_ROWS = 64  # inputs are predicted in blocks of at least this many rows, even if their covariances exceed ``BLOCK``
# Exponents of the kernel are computed from differences of inputs, not by matrix products, if products could cause a
# rounding error of the mean above this share of the prior standard deviation.
MEAN_TOLERANCE = 1e-8
# Exponents of the kernel are also computed from differences of inputs if products could cause a rounding error of the
# variance above this share of the prior variance.
VARIANCE_TOLERANCE = 5e-10
# And for sampled functions if products could cause a typical rounding error of a value above this share of the prior
# standard deviation. The random features of such a function have an error of some percent.
FUNCTION_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Output:
    """One output of a model: the function centre + scale * process, or the constant ``centre`` if ``posterior`` is
    None.

    ``inputs`` are the columns of x that the process reads; ``column`` is the output's column in the predicted means.
    """

    column: int
    posterior: Posterior | None
    inputs: tuple[int, ...]
    centre: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True)
class _Process:
    """Tensors of one output for predictions by matrix products. Its process has n points and d inputs; z = [x, x^2, 1]
    has D entries."""

    span: slice  # columns of ``Serving.exponents`` that belong to the output
    inputs: Tensor  # (d,) indices of the model's inputs that the process reads
    inverse_lengthscale: Tensor  # (d,) 1 / lengthscale
    scaled: Tensor  # (n, d) points divided by length scales; with a reflection also their mirror images, (2 n, d)
    factor: Tensor  # (n, n) lower Cholesky factor L, divided by sigma_f^2
    # (D, n) factors of the D entries of z = [x, x^2, 1] in the polynomial covariances with n points, over sigma_f^2.
    polynomial: Tensor | None
    # (D,) factors of the squares of z = [x, x^2, 1] in the prior variance, without the part of the mirror image.
    prior: Tensor
    signal_variance: float
    parity: int  # 1 for even functions, -1 for odd functions, 0 without a reflection
    # (D,) factors of z = [x, x^2, 1], which has D entries, in the exponent of the squared exponential between x and its
    # mirror image.
    mirror: Tensor | None
    scale: float
    mean_by_differences: bool
    variance_by_differences: bool
    pathwise: Pathwise

    @cached_property
    def function_by_differences(self) -> bool:
        """Whether products would round the values of sampled functions too much."""
        posterior = self.pathwise.posterior
        error = posterior.hyper.signal_variance * _exponent_error(posterior) * self.pathwise.size_of_update
        return error / _least_deviation(posterior.hyper) > FUNCTION_TOLERANCE

    def exponent(self, x: Tensor) -> Tensor:
        """Return the exponents of the squared exponentials of inputs x (m, width) with all n points, (m, n), computed
        from differences because these round less than products."""
        a = x.index_select(-1, self.inputs) * self.inverse_lengthscale
        distance = torch.cdist(a, self.scaled, compute_mode="donot_use_mm_for_euclid_dist")
        exponent: Tensor = distance.square_().mul_(-0.5)
        return exponent

    def correlations(self, x: Tensor, z: Tensor, smooth: Tensor, *, differences: bool) -> Tensor:
        """Return the prior covariances with the n points over sigma_f^2, (m, n). Overwrites this output's columns of
        ``smooth``.

        Args:
            x: all inputs of the model at m points, (m, width).
            z: [x, x^2, 1], (m, D).
            smooth: squared exponentials with the points of all processes, (m, S).
            differences: whether the exponents have to be computed from differences.
        """
        k = self.exponent(x).exp_() if differences and not self.mean_by_differences else smooth[:, self.span]
        if self.mirror is not None:
            k, images = k.chunk(2, 1)
            k.add_(images, alpha=self.parity)
        return k if self.polynomial is None else k.addmm_(z, self.polynomial)

    def std(self, z: Tensor, squared: Tensor, k: Tensor) -> Tensor:
        """Return the standard deviation without noise, (m,), in the output's unit, from z = [x, x^2, 1] (m, D), its
        elementwise square, and the result k (m, n) of ``correlations``."""
        prior = squared @ self.prior
        if self.mirror is not None:
            prior.add_((z @ self.mirror).exp_(), alpha=self.parity * self.signal_variance)
        v = torch.linalg.solve_triangular(self.factor, k.T, upper=False)
        variance = prior - torch.linalg.vector_norm(v, dim=0).square_()
        std: Tensor = variance.clamp_min_(0).sqrt_().mul_(self.scale)
        return std


@dataclass(frozen=True)
class Serving:
    """Outputs of a model, arranged so that few matrix products predict all of them at inputs x (m, width), each of the
    m points with the ``width`` inputs of the model. A prediction (m, O) has O columns, 0 where there is no output."""

    # A (D, S): factors of the D entries of z = [x, x^2, 1] in the kernel's exponents for S points of all processes.
    exponents: Tensor
    weights: Tensor  # W (S, O): weights of the S points in the means of O outputs, multiplied by the outputs' scales
    # Q (D, O): factors of z = [x, x^2, 1] in the polynomial parts of the means of O outputs, in their units.
    polynomials: Tensor
    processes: dict[int, _Process]  # process of each output column; constant outputs have none

    @classmethod
    def of(cls, outputs: Sequence[Output], columns: int, width: int, device: torch.device = CPU) -> Serving:
        """Arrange outputs for prediction on one device.

        Args:
            outputs: the outputs, each with its column.
            columns: number of columns of the means; those without an output stay 0.
            width: number of inputs of the model.
            device: where predictions run.
        """
        total = sum(len(_points(o.posterior)) for o in outputs if o.posterior is not None)
        like = torch.zeros(0, dtype=torch.float64, device=device)
        exponents, weights = like.new_zeros(2 * width + 1, total), like.new_zeros(total, columns)
        polynomials = like.new_zeros(2 * width + 1, columns)
        processes, begin = {}, 0
        for output in outputs:
            polynomials[-1, output.column] = output.centre
            if (posterior := output.posterior) is None:
                continue
            span = slice(begin, begin := begin + len(_points(posterior)))
            polynomial = _polynomial(posterior, output.inputs, width)
            exponents[:, span] = _exponents(posterior, output.inputs, width)
            weights[span, output.column] = output.scale * posterior.hyper.signal_variance * _weights(posterior)
            polynomials[:, output.column] += output.scale * (polynomial @ posterior.weights)
            processes[output.column] = _process(output, posterior, span, polynomial, width)
        return cls(exponents, weights, polynomials, processes)

    @property
    def rows(self) -> int:
        """Number of rows of x that are predicted at once."""
        block = BLOCK if self.exponents.device == CPU else GPU_BLOCK
        return max(MIN_ROWS, block // max(1, self.exponents.shape[1]))

    def mean(self, x: Tensor) -> Tensor:
        """Return the predicted means (m, O), in O columns, at m points x (m, width) with the ``width`` inputs of the
        model."""
        return in_blocks(self.rows, lambda rows: (self._means(*self._covariances(rows)),), x)[0]

    def mean_and_std(
        self, x: Tensor, columns: Sequence[int], paths: Tensor | None = None, begin: int = 0
    ) -> tuple[Tensor, Tensor]:
        """Return means (m, O), and standard deviations without noise (m, O), at x (m, width). Only the standard
        deviations of ``columns`` are computed; those of other columns are 0.

        With ``paths`` (m, W) the means are replaced by the values of a sampled function for each row. Its weights begin
        at the index ``begin``: those of each process, in the order of ``processes``.
        """

        def block(rows: Tensor, paths: Tensor | None) -> tuple[Tensor, Tensor]:
            z, smooth = self._covariances(rows)
            mean, squared = self._means(z, smooth), z.square()
            std, end = torch.zeros_like(mean), begin
            for column, process in self.processes.items():
                if paths is None and column not in columns:
                    continue
                differences = (column in columns and process.variance_by_differences) or (
                    paths is not None and process.function_by_differences
                )
                k = process.correlations(rows, z, smooth, differences=differences)
                if paths is not None:
                    weights = paths[:, end : (end := end + process.pathwise.size)]
                    own = rows.index_select(1, process.inputs)
                    mean[:, column] += process.scale * process.pathwise.residual(own, weights, k)
                if column in columns:
                    std[:, column] = process.std(z, squared, k)
            return mean, std

        mean, std = in_blocks(self.rows, block, x, paths)
        return mean, std

    def _covariances(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return z = [x, x^2, 1] (m, D), and the squared exponentials (m, S) of inputs x (m, width) with the S points
        of all processes."""
        z = torch.cat([x, x * x, x.new_ones(len(x), 1)], -1)
        exponent = z @ self.exponents
        for process in self.processes.values():
            if process.mean_by_differences:
                exponent[:, process.span] = process.exponent(x)
        return z, exponent.exp_()

    def _means(self, z: Tensor, smooth: Tensor) -> Tensor:
        return torch.addmm(z @ self.polynomials, smooth, self.weights)


def _process(output: Output, posterior: Posterior, span: slice, polynomial: Tensor, width: int) -> _Process:
    hyper = posterior.hyper
    mean_error, variance_error = _error_bounds(posterior)
    mirror = None
    if hyper.reflection is not None:
        mirror = _in_z(*_squares_alone(to_mirror(hyper)), output.inputs, width)[:, 0]
    return _Process(
        span=span,
        inputs=torch.tensor(output.inputs, device=posterior.x.device),
        inverse_lengthscale=1 / hyper.lengthscale,
        scaled=_points(posterior) / hyper.lengthscale,
        factor=posterior.factor / hyper.signal_variance,
        polynomial=polynomial / hyper.signal_variance if hyper.has_polynomial else None,
        prior=_prior(hyper, output.inputs, width),
        signal_variance=hyper.signal_variance,
        parity=0 if hyper.reflection is None else hyper.reflection.parity,
        mirror=mirror,
        scale=output.scale,
        mean_by_differences=mean_error > MEAN_TOLERANCE,
        variance_by_differences=variance_error > VARIANCE_TOLERANCE,
        pathwise=Pathwise(posterior),
    )


def _points(posterior: Posterior) -> Tensor:
    """Return the points with which inputs have squared exponentials: the n points of the process (n, d), or with a
    reflection these and then their mirror images (2 n, d)."""
    if (reflection := posterior.hyper.reflection) is None:
        return posterior.x
    return torch.cat([posterior.x, posterior.x * reflection.signs])


def _weights(posterior: Posterior) -> Tensor:
    """Return the weights of the n points in the posterior mean (n,), or with a reflection these and then those of the
    mirror images (2 n,)."""
    if (reflection := posterior.hyper.reflection) is None:
        return posterior.weights
    return torch.cat([posterior.weights, reflection.parity * posterior.weights])


def _exponents(posterior: Posterior, inputs: Sequence[int], width: int) -> Tensor:
    """Return the columns of the matrix A for one process, (D, n), or (D, 2 n) with mirror images. The product of z =
    [x, x^2, 1] and A gives the exponents of the squared exponentials. ``inputs`` are the indices of the process's
    inputs among the ``width`` inputs of the model."""
    points = _points(posterior)
    precision = posterior.hyper.lengthscale.square().reciprocal()
    scaled = points / posterior.hyper.lengthscale
    linear, quadratic = (points * precision).T, (-0.5 * precision)[:, None].expand(-1, len(scaled))
    return _in_z(linear, quadratic, -0.5 * scaled.square().sum(1), inputs, width)


def _polynomial(posterior: Posterior, inputs: Sequence[int], width: int) -> Tensor:
    """Return the coefficients R (D, n) of z = [x, x^2, 1] in the polynomial covariances of an input x with the n points
    of one process. ``inputs`` are the indices of the process's inputs among the ``width`` inputs of the model."""
    polynomial, x = posterior.hyper.polynomial, posterior.x
    constant = x.new_full((len(x),), polynomial.constant)
    return _in_z((x * polynomial.linear).T, (x.square() * polynomial.quadratic).T, constant, inputs, width)


def _prior(hyper: Hyperparameters, inputs: Sequence[int], width: int) -> Tensor:
    """Return the coefficients p (D,) of the prior variance k(x, x) = z^2 p, with z^2 = [x^2, x^4, 1]. ``inputs`` are
    the indices of the process's inputs among the ``width`` inputs of the model."""
    polynomial = hyper.polynomial
    constant = polynomial.linear.new_full((1,), hyper.signal_variance + polynomial.constant)
    return _in_z(polynomial.linear[:, None], polynomial.quadratic[:, None], constant, inputs, width)[:, 0]


def _squares_alone(coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the linear (d, 1), quadratic (d, 1) and constant (1,) coefficients of the function sum_j c_j x_j^2, with
    coefficients c (d,)."""
    column = coefficients[:, None]
    return torch.zeros_like(column), column, coefficients.new_zeros(1)


def _in_z(linear: Tensor, quadratic: Tensor, constant: Tensor, inputs: Sequence[int], width: int) -> Tensor:
    """Arrange the coefficients of n quadratic functions of d inputs as a matrix M, so that z M with z = [x, x^2, 1] are
    their values for all inputs x of the model.

    Args:
        linear, quadratic: coefficients of the inputs and their squares, (d, n) each.
        constant: constant of each function, (n,).
        inputs: indices of the d inputs among the ``width`` inputs of the model.

    Returns:
        The matrix M, (2 width + 1, n).
    """
    rows = linear.new_zeros(2 * width + 1, linear.shape[1])
    at = torch.tensor(inputs, device=linear.device)
    rows[at], rows[width + at], rows[-1] = linear, quadratic, constant
    return rows


def _error_bounds(posterior: Posterior) -> tuple[float, float]:
    """Return bounds on the rounding errors of mean and variance if exponents are computed by matrix products. They hold
    for inputs up to twice as far from the origin as the farthest point.

    With delta the largest error of an exponent and s^2 = k(x, x), the error of the mean is at most sigma_f^2 delta
    |beta|_1, and that of the variance 2 |L^-1 k| |L^-1 dk| <= 2 s sigma_f^2 delta sqrt(n) / sigma_n. They are returned
    as shares of s and s^2, with sigma_f^2 + sigma_l^2 as the smallest s^2, or sigma_f^2 for an odd process, whose
    variance is 0 on the mirror, where its value is known. Mirror images double both errors.
    """
    hyper, n = posterior.hyper, len(posterior.x)
    delta, s = _exponent_error(posterior), _least_deviation(hyper)
    mean = hyper.signal_variance * delta * float(posterior.weights.abs().sum()) / s
    noise = math.sqrt(hyper.noise_variance + posterior.jitter)
    return mean, 2 * hyper.signal_variance * delta * math.sqrt(n) / max(noise * s, 1e-300)


def _exponent_error(posterior: Posterior) -> float:
    """Return delta, a bound on the rounding error of an exponent that is computed by products; twice that with mirror
    images."""
    hyper = posterior.hyper
    reach = float((posterior.x / hyper.lengthscale).square().sum(1).max())
    delta = (2 * posterior.x.shape[1] + 2) * torch.finfo(posterior.x.dtype).eps * 4.5 * reach
    return delta if hyper.reflection is None else 2 * delta


def _least_deviation(hyper: Hyperparameters) -> float:
    """Return the smallest prior standard deviation, s."""
    return math.sqrt(hyper.signal_variance + hyper.polynomial.constant)
