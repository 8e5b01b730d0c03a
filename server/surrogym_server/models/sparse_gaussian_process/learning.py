"""What this family does with many samples: hyperparameters and inducing points by the bound of all of them."""

from __future__ import annotations

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
    condition_sparse,
    fewer_inputs,
    fit_bound,
)
from surrogym_server.models.gaussian_process.learning.many import ManySamples


@dataclass(frozen=True)
class ByBound(ManySamples):
    """Hyperparameters that maximise the variational bound through at most ``inducing`` points."""

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
