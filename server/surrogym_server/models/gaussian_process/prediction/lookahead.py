"""Effect of further real steps on the standard deviations of processes, before they are taken.

The standard deviations of a process depend on where it is observed, not on the observed values. So the outlook after a
query needs no guess of its answer. Only processes that read a predicted value (the lead, the next state of a reward)
use the present model's prediction.

The first t points of a predicted path give the following information about an output:

    I(t) = 1/2 log det(1 + W S W / tau^2),

S (t, t) is the posterior covariance of the process at these points, tau the output's tolerance, W a diagonal matrix of
weights. The determinant evaluates each point given those before it, so a repeated point adds nothing. Reference: A.
Krause, A. Singh, C. Guestrin (2008), JMLR 9, section 2 (information of a set of observations).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import encode, leading
from surrogym_server.gp import Joint
from surrogym_server.models.abilities import OutputOutlook, PathOutlook, PredictedSteps
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

BLOCK = 4_000_000  # greatest number of covariances held at once
ROUNDING = 1e-12
SMALLEST = 1e-300  # avoids a division by 0 where every slope is 0


@dataclass(frozen=True)
class ProcessOutlook(OutputOutlook):
    """Forecast of one output's standard deviations at candidates, in the output's unit."""

    joint: Joint  # process at m candidates, r reference points and the assumed queries, in this order
    learns: Tensor  # (m,) bool: whether a sample at the candidate would improve the output
    shared: Tensor  # (r, m) standardised covariance of reference points and candidates
    scale: float
    slope: Tensor | None = None  # (m + r,) derivative of the output over its process, in scales; None if 1 everywhere

    @classmethod
    def of(cls, output: OutputModel, x: Tensor, learns: Tensor, spans: tuple[int, int]) -> ProcessOutlook:
        """Build the outlook of an output.

        Args:
            output: an output with a process.
            x: inputs (m + r + p, d) of m candidates, r reference points and p queries that are assumed answered.
            learns: (m + r + p,) bool: whether a sample at the point would improve the output.
            spans: (m, m + r), the ends of candidates and reference points in x.
        """
        assert output.posterior is not None
        joint = Joint.of(output.posterior, x)
        for index in range(spans[1], len(x)):
            joint = joint.observe(index) if learns[index] else joint
        shared = joint.between(slice(*spans), slice(spans[0]))
        return cls(joint, learns[: spans[0]], shared, output.scale, slope_at(output, x[: spans[1]]))

    @property
    def std(self) -> Tensor:
        count = len(self.learns)
        std = self.scale * self.joint.variance[:count].sqrt()
        return std if self.slope is None else std * self.slope[:count]

    def reduction(self, weights: Tensor) -> Tensor:
        """Return sum_r w_r k(x_r, x)^2 / (k(x, x) + sigma_n^2) at each candidate x, (m,), with weights w (r,).

        Cohn (NIPS 1993), in closed form for a Gaussian process. With a slope each reference point is also weighted by
        its squared slope relative to the steepest. Only the order of the values matters.
        """
        if self.slope is not None:
            steep = self.slope[len(self.learns) :]
            weights = weights * (steep / steep.max().clamp_min(SMALLEST)).square()
        spread = self.joint.variance[: len(self.learns)] + self.joint.noise
        return self.scale**2 * (weights @ self.shared.square()) / spread

    def observe(self, index: int) -> ProcessOutlook:
        if not self.learns[index]:
            return self
        joint = self.joint.observe(index)
        row, (r, m) = joint.observed[-1], self.shared.shape
        return replace(self, joint=joint, shared=torch.addr(self.shared, row[m : m + r], row[:m], alpha=-1))


@dataclass(frozen=True)
class ProcessAlongPaths(PathOutlook):
    """Forecast of one output along paths of predicted steps."""

    definition: EnvironmentDefinition
    output: OutputModel
    x: Tensor  # (b, T, d) inputs of the output's process
    learns: Tensor  # (b, T) bool: whether a real step at that point would improve the output

    @property
    def std(self) -> Tensor:
        return self.output.mean_and_std(self.x.flatten(0, 1))[1].reshape(self.learns.shape)

    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        output = self.output
        assert output.posterior is not None
        room = max(1, BLOCK // (self.x.shape[1] * (self.x.shape[1] + len(output.posterior.y))))
        if (slope := slope_at(output, self.x.flatten(0, 1))) is not None:
            weight = weight * slope.reshape(weight.shape)
        blocks = zip(torch.split(self.x, room), torch.split(weight, room), strict=True)
        # Below the noise floor a covariance is rounding, which a very small tolerance would scale up beyond 1.
        ratio = min((output.scale / tolerance) ** 2, 1 / output.noise_floor)
        return torch.cat([_log_determinants(ratio * output.posterior.joint_covariance(b), w) for b, w in blocks])


def process_inputs(definition: EnvironmentDefinition, output: OutputModel, steps: PredictedSteps) -> Tensor:
    """Return the inputs (..., d) that one output's process reads at the given steps."""
    state = steps.q_next if output.feature_map.after else steps.q
    return encode(definition, output.feature_map, state, steps.u, steps.q_next[..., leading(definition)])


def slope_at(output: OutputModel, x: Tensor) -> Tensor | None:
    """Return the derivative of an output over its process, in scales, at inputs x (m, d): (m,), or None if it is 1
    everywhere."""
    if output.warp is not None:
        return output.warp.slope(*output.target(x))
    return output.amplitude(x) if output.feature_map.rates else None


def as_if_answered(output: OutputModel, x: Tensor) -> OutputModel:
    """Condition an output on observations of its own mean at inputs x (k, d): the variance shrinks, the mean stays."""
    if (posterior := output.posterior) is not None:
        for point in x:
            posterior = posterior.extend(point, posterior.mean(point[None])[0])
    return replace(output, posterior=posterior)


def _log_determinants(covariance: Tensor, weight: Tensor) -> Tensor:
    """Return 1/2 log det(1 + W S W) for the first t points of each path, t = 1 to T, (b, T).

    Args:
        covariance: S (b, T, T).
        weight: diagonal of W, (b, T).
    """
    one = torch.eye(weight.shape[1], dtype=weight.dtype)
    factor: Tensor = torch.linalg.cholesky(one + weight[:, :, None] * covariance * weight[:, None, :])
    return factor.diagonal(dim1=-2, dim2=-1).log().cumsum(-1)
