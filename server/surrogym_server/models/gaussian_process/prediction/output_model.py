"""Model of one output: its Gaussian process, its inputs, and the scaling of its targets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import NOISE_FLOOR, FitOptions, LeftOut, Posterior, noisy_explanation
from surrogym_server.gp.kernel import variance
from surrogym_server.models.abilities import LeaveOneOutErrors
from surrogym_server.models.gaussian_process.prediction.warp import PEAK_NOISE, Warp
from surrogym_server.tensors import amplitude, constant


@dataclass(frozen=True)
class OutputModel:
    """Model of one output: a process, and the scaling of its targets: y = (target - centre) / (scale * amplitude).

    The amplitude is 1, unless the feature map has rates (see ``gp.growth``), with which it grows along the inputs. An
    output that never varied has no ``posterior``; its mean is ``centre`` and its standard deviation 0. With a ``warp``
    the targets are logarithms of the output; means, standard deviations and errors are still in the output's unit.
    """

    name: str
    feature_map: FeatureMap
    posterior: Posterior | None
    centre: float
    scale: float
    left_out: int = 0  # number of samples that were not used, because they ended at a bound or ended the episode
    # Name and score of every candidate that was compared, usually the log evidence of an encoding of state and action.
    scores: tuple[tuple[str, float], ...] = ()
    warp: Warp | None = None
    # Whether the output also learned from samples that ended at a bound of another coordinate.
    past_limits: bool = False
    # For each point of the process, 1 if it ended at the upper bound of the output's coordinate, -1 at the lower,
    # otherwise 0. The tuple is empty if no point ended at a bound.
    at_limit: tuple[int, ...] = ()
    # Names of other outputs from whose samples this output learned too, see ``gp.pooling``.
    shared: tuple[str, ...] = ()
    # Standard deviation, over the samples, of the output together with the prior model's prediction to which it is
    # added; None if no prior model's prediction is added.
    size_with_prior: float | None = None

    def mean(self, x: Tensor) -> Tensor:
        """Return the posterior mean (m,) at features x (m, d), in the output's unit."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre)
        mean = self.centre + self.scale * self.amplitude(x) * self.posterior.mean(x)
        return mean if self.warp is None else self.warp.value(mean)

    def mean_and_std(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posterior mean (m,) and the standard deviation without noise (m,) at features x (m, d), in the
        output's unit."""
        return paid(self.warp, *self.target(x))

    def target(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posterior mean (m,) and the standard deviation without noise (m,) at features x (m, d), in the
        unit of the targets (logarithms of the output if there is a ``warp``)."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre), x.new_zeros(x.shape[:-1])
        mean, variance = self.posterior.mean_and_variance(x)
        scale = self.scale * self.amplitude(x)
        return self.centre + scale * mean, scale * variance.sqrt()

    def amplitude(self, x: Tensor) -> Tensor:
        """Return the amplitude (m,) by which the output's distance from ``centre`` is scaled at each of m inputs x (m,
        d). It is 1 if the feature map has no rates (see ``gp.growth``)."""
        rates = self.feature_map.rates
        return amplitude(x, constant(rates, x.device)) if rates else x.new_ones(x.shape[:-1])

    def standardised(self, target: Tensor, x: Tensor) -> Tensor:
        """Return the standardised targets (m,) of the process, given the targets ``target`` (m,) at inputs x (m, d)."""
        return (target - self.centre) / (self.scale * self.amplitude(x))

    @property
    def size(self) -> float:
        """Standard deviation of the output over the samples, in its unit; 1 for an output that never varied."""
        if self.size_with_prior is not None:
            return self.size_with_prior
        return self.scale if self.warp is None else self.warp.size

    @property
    def function_variance(self) -> float:
        """Variance of the output's function before any sample, in its unit squared, where its amplitude is 1: mean over
        the points of its process; infinite for an output without a process."""
        if self.posterior is None:
            return math.inf
        return self.scale**2 * float(variance(self.posterior.hyper, self.posterior.x).mean())

    @property
    def noise_floor(self) -> float:
        """Smallest noise variance that a fit of this output may choose, as a share of the variance of its targets."""
        return NOISE_FLOOR if self.warp is None else PEAK_NOISE

    @property
    def noise_std(self) -> float:
        """Standard deviation of the learned noise, in the output's unit.

        If a reward is learned by its logarithm (``warp``), this is the noise at a reward that is ``size`` away from the
        base, the reward far from a peak. If the feature map has rates, the noise depends on the inputs, and this is its
        root mean square over the points.
        """
        return 0.0 if self.posterior is None else self._of_noise(self.posterior.hyper.noise_variance)

    @property
    def possible_noise(self) -> float:
        """Greatest plausible standard deviation of the noise, in the output's unit: ``noise_std``, or the noise of
        other hyperparameters with more noise, if the points are at least as likely under them."""
        if self.posterior is None:
            return 0.0
        hyper = self.posterior.hyper
        options = FitOptions(hyper.linear_variance > 0, hyper.quadratic_variance > 0, noise_floor=self.noise_floor)
        return max(self.noise_std, self._of_noise(noisy_explanation(self.posterior, options)))

    def _of_noise(self, variance: float) -> float:
        noise = self.scale * self._typical_amplitude * math.sqrt(variance)
        return noise if self.warp is None else noise * self.warp.size

    def leave_one_out(self) -> LeaveOneOutErrors:
        """Return the leave-one-out errors of the output; 0 for an output that never varied.

        If a point ended at a limit, a prediction beyond the limit counts as error 0.
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
        """Return the mean and variance with which each of n targets is predicted from the others, (n,) each. If a point
        ended at a limit, a prediction beyond the limit is replaced by the limit."""
        mean, variance = posterior.leave_one_out()
        side = mean.new_tensor(self.at_limit or [0] * len(mean))
        beyond = side * (mean - posterior.y) > 0
        return torch.where(beyond, posterior.y, mean), variance

    @property
    def _typical_amplitude(self) -> float:
        """Root mean square of the amplitude over the points of the process; 1 if the feature map has no rates."""
        if self.posterior is None or not self.feature_map.rates:
            return 1.0
        return float(self.amplitude(self.posterior.x).square().mean().sqrt())

    def _left_out_grown(self, error: float) -> float:
        """Return the root mean square leave-one-out error of an output with rates, in its unit. If the process has
        inducing points, it is computed from ``error``, the leave-one-out error of the standardised targets."""
        assert self.posterior is not None
        if self.posterior.sparse is not None:
            return self.scale * self._typical_amplitude * error
        mean, _ = self._predictions_left_out(self.posterior)
        off = self.scale * self.amplitude(self.posterior.x) * (mean - self.posterior.y)
        return float(off.square().mean().sqrt())

    def _left_out_warped(self, warp: Warp, error: float) -> float:
        """Return the root mean square leave-one-out error of rewards that are learned by their logarithms. If the
        process has inducing points, it is computed from ``error``, the leave-one-out error of the logarithms."""
        assert self.posterior is not None
        if self.posterior.sparse is not None:
            return error * warp.size
        mean, _ = self._predictions_left_out(self.posterior)
        predictions, rewards = (warp.value(self.centre + self.scale * y) for y in (mean, self.posterior.y))
        return float((predictions - rewards).square().mean().sqrt())


def paid(warp: Warp | None, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Convert mean and standard deviation (m,) of an output's targets to the output's unit. With a ``warp`` the targets
    are logarithms of rewards; without it, mean and standard deviation are returned unchanged."""
    return (mean, std) if warp is None else (warp.value(mean), warp.std(mean, std))
