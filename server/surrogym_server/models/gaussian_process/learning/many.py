"""Strategies for fitting a process to more samples than are used to choose its inputs and its kernel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.gp import (
    Censored,
    Fewer,
    FitOptions,
    Hyperparameters,
    Posterior,
    Reflection,
    condition_many,
    condition_sparse,
    fewer_inputs,
    fit_bound,
    fit_some,
    fit_through_few,
    loses_nothing,
    refine,
    refine_where_hard,
)
from surrogym_server.gp.subsets import SOME

# If the leave-one-out error is at most this, in standard deviations of the targets, the process predicts well enough,
# so that no other inputs or hyperparameters are searched for.
EXPLAINED = 0.01


class ManySamples(ABC):
    """Strategy for fitting a process to many points, when its inputs and its kernel are already chosen."""

    @abstractmethod
    def fitted(
        self,
        x: Tensor,
        y: Tensor,
        options: FitOptions,
        theta: NDArray[np.float64],
        mirror: Reflection | None,
        at_limit: Censored | None,
    ) -> Posterior:
        """Fit a process to all points x (n, d), y (n,), both standardised.

        Args:
            options: options of the fit.
            theta: logarithms of hyperparameters that were fitted to a subset of the points.
            mirror: symmetry of the process, or None.
            at_limit: points at which only a bound of the function is known, or None; they may help to choose
                hyperparameters.

        Raises:
            NumericalFailure: no jitter makes the covariance of the points positive definite.
        """

    @abstractmethod
    def conditioned(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> Posterior:
        """Condition a process with known hyperparameters on x (n, d) and y (n,), through inducing points.

        Raises:
            NumericalFailure: no jitter makes the covariance of the points positive definite.
        """

    @abstractmethod
    def fewer_inputs(
        self, x: Tensor, y: Tensor, options: FitOptions, posterior: Posterior, may: Tensor, odds: float
    ) -> Fewer | None:
        """Leave out inputs of a process that has inducing points.

        Args:
            x, y: all of the process's points, (n, d) and (n,).
            options: options of the fit.
            posterior: the process with all inputs.
            may: (d,) bool, true for each input that may be left out.
            odds: by how much the log prior increases with each input that is left out.

        Returns:
            The process with fewer inputs, or None if all are kept.
        """


class BySubsets(ManySamples):
    """Strategy that fits hyperparameters to subsets of the samples.

    With more than ``gp.sparse.MAX_EXACT`` (2,000) points the process has inducing points. If its leave-one-out errors
    are large, hyperparameters fitted to the points with the largest errors are tried too. With fewer points the process
    is exact, unless inducing points lose no accuracy, see ``gp.variational_bound.loses_nothing``.
    """

    def fitted(
        self,
        x: Tensor,
        y: Tensor,
        options: FitOptions,
        theta: NDArray[np.float64],
        mirror: Reflection | None,
        at_limit: Censored | None,
    ) -> Posterior:
        theta = fit_some(x, y, options, theta, mirror)
        if (through_few := fit_through_few(x, y, options, theta, mirror)) is not None:
            return through_few
        posterior = condition_many(refine(x, y, options, theta, mirror), x, y, at_limit)
        if posterior.sparse is None or posterior.left_out.error <= EXPLAINED:
            return posterior
        return condition_many([refine_where_hard(posterior, x, y, options)], x, y, at_limit, earlier=posterior)

    def conditioned(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> Posterior:
        return condition_sparse(hyper, x, y)

    def fewer_inputs(
        self, x: Tensor, y: Tensor, options: FitOptions, posterior: Posterior, may: Tensor, odds: float
    ) -> Fewer | None:
        return fewer_inputs(x, y, posterior, options, SOME, may, odds) if loses_nothing(posterior) else None


@dataclass(frozen=True)
class ByBound(ManySamples):
    """Strategy that chooses hyperparameters by maximising the variational bound of the evidence of all samples, with at
    most ``inducing`` inducing points."""

    inducing: int

    def fitted(
        self,
        x: Tensor,
        y: Tensor,
        options: FitOptions,
        theta: NDArray[np.float64],
        mirror: Reflection | None,
        at_limit: Censored | None,
    ) -> Posterior:
        # Samples that ended at a bound help to choose between candidate hyperparameters, but here is only one
        # candidate.
        del at_limit
        return fit_bound(x, y, options, theta, self.inducing, mirror)

    def conditioned(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> Posterior:
        return condition_sparse(hyper, x, y, self.inducing)

    def fewer_inputs(
        self, x: Tensor, y: Tensor, options: FitOptions, posterior: Posterior, may: Tensor, odds: float
    ) -> Fewer | None:
        return fewer_inputs(x, y, posterior, options, self.inducing, may, odds)
