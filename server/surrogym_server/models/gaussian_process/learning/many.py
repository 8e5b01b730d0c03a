"""What a fit does with more samples than it compares structures on."""

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

EXPLAINED = 0.01  # a process whose error is smaller needs no other structure; in standard deviations of the targets


class ManySamples(ABC):
    """A way to fit a process to many points, given its structure."""

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
            theta: free parameters that were fitted to a subset.
            mirror: symmetry of the process, if it has one.
            at_limit: points of which only a side is known, if there are any; they may help to choose hyperparameters.

        Raises:
            NumericalFailure: as ``gp.condition``.
        """

    @abstractmethod
    def conditioned(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> Posterior:
        """Condition a process with known hyperparameters on x (n, d) and y (n,), through inducing points.

        Raises:
            NumericalFailure: as ``gp.condition``.
        """

    def fewer_inputs(
        self, x: Tensor, y: Tensor, options: FitOptions, posterior: Posterior, may: Tensor, odds: float
    ) -> Fewer | None:
        """Leave out inputs of a process through inducing points, from its points x (n, d), y (n,).

        ``may`` (d,) marks the inputs that may be left out, and ``odds`` are the log odds of each before any data. None
        if all are kept, which is the default.
        """
        del x, y, options, posterior, may, odds
        return None


class BySubsets(ManySamples):
    """Hyperparameters of subsets; the process is exact up to ``gp.sparse.MAX_EXACT`` points.

    Hyperparameters of the hard points are tried too, if the points are many and not foretold well from the others. A
    process goes through inducing points as soon as these lose nothing, see ``gp.bound.loses_nothing``.
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
    """Hyperparameters that maximise the variational bound of all samples, through at most ``inducing`` points."""

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
        del at_limit  # the bound counts what inducing points leave, so nothing is left to choose
        return fit_bound(x, y, options, theta, self.inducing, mirror)

    def conditioned(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> Posterior:
        return condition_sparse(hyper, x, y, self.inducing)

    def fewer_inputs(
        self, x: Tensor, y: Tensor, options: FitOptions, posterior: Posterior, may: Tensor, odds: float
    ) -> Fewer | None:
        return fewer_inputs(x, y, posterior, options, self.inducing, may, odds)
