"""One output of a model: its process, and the scaling of its targets."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import Posterior
from surrogym_server.models.abilities import LeaveOneOutErrors


@dataclass(frozen=True)
class OutputModel:
    """The process of one output, and the scaling of its targets: y = (target - centre) / scale.

    ``posterior`` is None for an output that never varied: its mean is ``centre`` and its deviation 0.
    """

    name: str
    feature_map: FeatureMap
    posterior: Posterior | None
    centre: float
    scale: float
    left_out: int = 0  # samples left out because they ended at a bound
    scores: tuple[tuple[str, float], ...] = ()  # evidence of every feature map compared

    def mean(self, x: Tensor) -> Tensor:
        """Posterior mean at features x (m, d), in the output's unit, (m,)."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre)
        return self.centre + self.scale * self.posterior.mean(x)

    def mean_and_deviation(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Posterior mean and latent deviation at x (m, d), in the output's unit, (m,) each."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre), x.new_zeros(x.shape[:-1])
        mean, variance = self.posterior.mean_and_variance(x)
        return self.centre + self.scale * mean, self.scale * variance.sqrt()

    @property
    def noise_deviation(self) -> float:
        """Deviation of the learned noise, in the output's unit."""
        return 0.0 if self.posterior is None else self.scale * math.sqrt(self.posterior.hyper.noise_variance)

    def leave_one_out(self) -> LeaveOneOutErrors:
        """How the process without each sample in turn foretells it. One that never varied makes no error."""
        if self.posterior is None:
            return LeaveOneOutErrors(0.0, 1.0, 1.0)
        found = self.posterior.left_out
        return LeaveOneOutErrors(self.scale * found.error, found.within_one, found.within_two)
