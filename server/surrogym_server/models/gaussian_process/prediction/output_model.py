"""Model of one output: its process, and the scaling of its targets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import NOISE_FLOOR, FitOptions, LeftOut, Posterior, noisy_explanation
from surrogym_server.models.abilities import LeaveOneOutErrors
from surrogym_server.models.gaussian_process.prediction.warp import PEAK_NOISE, Warp
from surrogym_server.tensors import amplitude


@dataclass(frozen=True)
class OutputModel:
    """Model of one output: a process, and the scaling of its targets: y = (target - centre) / (scale * amplitude).

    The amplitude is 1, unless the feature map has rates; it then grows along the inputs. ``posterior`` is None for an
    output that never varied; its mean is ``centre`` and its standard deviation 0. With a ``warp`` the targets are
    logarithms of the output; means, standard deviations and errors are still in the output's unit.
    """

    name: str
    feature_map: FeatureMap
    posterior: Posterior | None
    centre: float
    scale: float
    left_out: int = 0  # number of samples that were not used, because they ended at a bound
    scores: tuple[tuple[str, float], ...] = ()  # log evidence of every candidate feature map
    warp: Warp | None = None
    past_limits: bool = False  # whether the output learned from samples that ended at a limit of another coordinate
    # For each point: 1 if it ended at the upper limit, -1 at the lower, otherwise 0; () if none did.
    at_limit: tuple[int, ...] = ()
    # Names of other outputs from whose samples this output learned too, see ``gp.pooling``.
    shared: tuple[str, ...] = ()
    # Standard deviation of the output over the samples if its process is added to the prior model's prediction,
    # otherwise None.
    size_with_prior: float | None = None

    def mean(self, x: Tensor) -> Tensor:
        """Return the posterior mean at features x (m, d), in the output's unit, (m,)."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre)
        mean = self.centre + self.scale * self.amplitude(x) * self.posterior.mean(x)
        return mean if self.warp is None else self.warp.value(mean)

    def mean_and_std(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return posterior mean and standard deviation without noise at features x (m, d), in the output's unit, (m,)
        each."""
        return paid(self.warp, *self.target(x))

    def target(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return posterior mean and standard deviation without noise at features x (m, d), in the unit of the targets
        (logarithms of the output if there is a ``warp``), (m,) each."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre), x.new_zeros(x.shape[:-1])
        mean, variance = self.posterior.mean_and_variance(x)
        scale = self.scale * self.amplitude(x)
        return self.centre + scale * mean, scale * variance.sqrt()

    def amplitude(self, x: Tensor) -> Tensor:
        """Return the amplitude by which the output's distance from ``centre`` is scaled at inputs x (m, d), (m,); 1 if
        the feature map has no rates."""
        rates = self.feature_map.rates
        return amplitude(x, x.new_tensor(rates)) if rates else x.new_ones(x.shape[:-1])

    def standardised(self, target: Tensor, x: Tensor) -> Tensor:
        """Return the standardised values, in the unit of the process, of targets (m,) at inputs x (m, d), (m,)."""
        return (target - self.centre) / (self.scale * self.amplitude(x))

    @property
    def size(self) -> float:
        """Standard deviation of the output over the samples, in its unit; 1 for an output that never varied."""
        if self.size_with_prior is not None:
            return self.size_with_prior
        return self.scale if self.warp is None else self.warp.size

    @property
    def noise_floor(self) -> float:
        """Smallest noise variance that a fit may choose, as a share of the targets' variance."""
        return NOISE_FLOOR if self.warp is None else PEAK_NOISE

    @property
    def noise_std(self) -> float:
        """Standard deviation of the learned noise, in the output's unit.

        If the output is learned by its logarithm (``warp``), it is the noise at a reward that is ``size`` away from the
        base. With rates, whose amplitude depends on the inputs, it is a root mean square over the points.
        """
        return 0.0 if self.posterior is None else self._of_noise(self.posterior.hyper.noise_variance)

    @property
    def possible_noise(self) -> float:
        """Greatest plausible standard deviation of the noise, in the output's unit. If a search finds hyperparameters
        with more noise under which the points are at least as likely as under those of the process, it is their noise,
        otherwise ``noise_std``."""
        if self.posterior is None:
            return 0.0
        hyper = self.posterior.hyper
        options = FitOptions(hyper.linear_variance > 0, hyper.quadratic_variance > 0, noise_floor=self.noise_floor)
        return max(self.noise_std, self._of_noise(noisy_explanation(self.posterior, options)))

    def _of_noise(self, variance: float) -> float:
        noise = self.scale * self._typical_amplitude * math.sqrt(variance)
        return noise if self.warp is None else noise * self.warp.size

    def leave_one_out(self) -> LeaveOneOutErrors:
        """Return the leave-one-out errors of the process; 0 for an output that never varied.

        At a point that ended at a limit, a prediction beyond the limit counts as error 0.
        """
        if self.posterior is None:
            return LeaveOneOutErrors(0.0, 1.0, 1.0)
        left_out = self._left_out(self.posterior)
        error = self.scale * left_out.error
        if self.feature_map.rates:
            error = self._left_out_grown(left_out.error)
        if self.warp is not None:
            error = self._left_out_warped(self.warp, error)
        return LeaveOneOutErrors(error, left_out.within_one, left_out.within_two)

    def _left_out(self, posterior: Posterior) -> LeftOut:
        if posterior.sparse is not None:
            return posterior.left_out
        predictions, variance = self._predictions_left_out(posterior)
        return LeftOut.of(predictions - posterior.y, variance)

    def _predictions_left_out(self, posterior: Posterior) -> tuple[Tensor, Tensor]:
        """Return the mean and variance with which each target y is predicted from the others, (n,) each. A prediction
        beyond the limit at which a point ended is replaced by the limit."""
        mean, variance = posterior.leave_one_out()
        side = mean.new_tensor(self.at_limit or [0] * len(mean))
        beyond = side * (mean - posterior.y) > 0
        return torch.where(beyond, posterior.y, mean), variance

    @property
    def _typical_amplitude(self) -> float:
        """Root mean square over the points of the amplitude (1 if the feature map has no rates)."""
        if self.posterior is None or not self.feature_map.rates:
            return 1.0
        return float(self.amplitude(self.posterior.x).square().mean().sqrt())

    def _left_out_grown(self, error: float) -> float:
        """Return the root mean square leave-one-out error of an output with rates, in its unit. ``error`` is that of
        the standardised targets, used if the process has inducing points."""
        assert self.posterior is not None
        if self.posterior.sparse is not None:
            return self.scale * self._typical_amplitude * error
        mean, _ = self._predictions_left_out(self.posterior)
        off = self.scale * self.amplitude(self.posterior.x) * (mean - self.posterior.y)
        return float(off.square().mean().sqrt())

    def _left_out_warped(self, warp: Warp, error: float) -> float:
        """Return the root mean square leave-one-out error of rewards that are learned by their logarithms. ``error`` is
        that of the logarithms, used if the process has inducing points."""
        assert self.posterior is not None
        if self.posterior.sparse is not None:
            return error * warp.size
        mean, _ = self._predictions_left_out(self.posterior)
        predictions, rewards = (warp.value(self.centre + self.scale * y) for y in (mean, self.posterior.y))
        return float((predictions - rewards).square().mean().sqrt())


def paid(warp: Warp | None, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (m,) in the output's unit, given those of its targets. With a ``warp`` the
    targets are logarithms, otherwise they are returned unchanged."""
    return (mean, std) if warp is None else (warp.value(mean), warp.std(mean, std))
