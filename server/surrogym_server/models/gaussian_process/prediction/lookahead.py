"""Forecast of the standard deviations of processes after further real steps, before these steps are taken.

The standard deviations of a process depend on where it is observed, not on the observed values. So the forecast needs
no guess of a step's result. Only processes that read a predicted value (the next value of another coordinate, or the
next state) use the model's prediction of it.

The first t points of a predicted path give the following information about an output:

    I(t) = 1/2 log det(1 + W S W / tau^2),

S (t, t) is the posterior covariance of the process at these points, tau the output's tolerance, W a diagonal matrix of
weights. The determinant counts each point given those before it, so a repeated point adds little. Reference: A. Krause,
A. Singh, C. Guestrin (2008), JMLR 9, section 2 (information of a set of observations).
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

BLOCK = 4_000_000  # greatest number of covariances computed at once
SMALLEST = 1e-300  # slopes are divided by the largest slope, or by this if all are 0
# A reference point where an output's difference from its prior model has the root mean square slope counts as so many
# points more.
DIFFERENCE = 4.0


@dataclass(frozen=True)
class ProcessOutlook(OutputOutlook):
    """Forecast of one output's standard deviations at m candidates for real steps, in the output's unit, as if certain
    other real steps had been taken."""

    joint: Joint  # process at m candidates, r reference points and the steps that are assumed taken, in this order
    learns: Tensor  # (m,) bool, true for each candidate at which a real step would teach the output something
    shared: Tensor  # (r, m) posterior covariance of the standardised process at reference points and candidates
    scale: float
    # (m + r,) derivative of the output with respect to its process, divided by ``scale``; None if it is 1 everywhere.
    slope: Tensor | None = None
    # (r,) further weight of each reference point of an output that is added to a prior model's prediction; None without
    further: Tensor | None = None

    @classmethod
    def of(cls, output: OutputModel, x: Tensor, learns: Tensor, spans: tuple[int, int]) -> ProcessOutlook:
        """Build the forecast for an output.

        Args:
            output: an output with a process.
            x: inputs (m + r + p, d) of m candidates, r reference points and p real steps that are assumed taken.
            learns: (m + r + p,) bool, true for each point at which a real step would teach the output something.
            spans: (m, m + r), the rows of x at which the candidates and the reference points end.
        """
        assert output.posterior is not None
        joint = Joint.of(output.posterior, x)
        for index in range(spans[1], len(x)):
            joint = joint.observe(index) if learns[index] else joint
        shared = joint.between(slice(*spans), slice(spans[0]))
        further = _weight_of_difference(output, x[slice(*spans)])
        return cls(joint, learns[: spans[0]], shared, output.scale, slope_at(output, x[: spans[1]]), further)

    @property
    def std(self) -> Tensor:
        count = len(self.learns)
        std = self.scale * self.joint.variance[:count].sqrt()
        return std if self.slope is None else std * self.slope[:count]

    def reduction(self, weights: Tensor) -> Tensor:
        """Return by how much a real step at each of m candidates x would lower the weighted sum of the variances at the
        reference points x_r: sum_r w_r k(x_r, x)^2 / (k(x, x) + sigma_n^2), (m,), with the posterior covariance k and
        weights w (r,).

        This is Cohn's criterion (NIPS 1993) in closed form for a Gaussian process. If the output is a nonlinear
        function of its process, each reference point is also weighted by the squared derivative of this function,
        divided by the largest. Only the order of the results matters.

        An output beside a prior model also weighs reference points by how steep the difference from the prior is there.
        What a simulator lacks is often local, and the process is equally steep everywhere before any sample.
        """
        weights = weights if self.further is None else weights * self.further
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
    """Forecast of one output's standard deviations along b predicted paths of T steps, and of the information that real
    steps along them would give."""

    definition: EnvironmentDefinition
    output: OutputModel
    x: Tensor  # (b, T, d) inputs of the output's process at each of T steps of b paths
    learns: Tensor  # (b, T) bool, true for each step of a path that would teach the output something

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
        # Covariances below the noise floor are rounding errors. A very small tolerance would scale them up to more than
        # 1, so the ratio that scales covariances is limited.
        ratio = min((output.scale / tolerance) ** 2, 1 / output.noise_floor)
        return torch.cat([_log_determinants(ratio * output.posterior.joint_covariance(b), w) for b, w in blocks])


def process_inputs(definition: EnvironmentDefinition, output: OutputModel, steps: PredictedSteps) -> Tensor:
    """Return the d inputs (..., d) of one output's process at predicted steps, with the same leading dimensions."""
    state = steps.q_next if output.feature_map.after else steps.q
    return encode(definition, output.feature_map, state, steps.u, steps.q_next[..., leading(definition)])


def slope_at(output: OutputModel, x: Tensor) -> Tensor | None:
    """Return the derivative (m,) of an output with respect to its process at inputs x (m, d), divided by the output's
    scale; None if it is 1 everywhere."""
    if output.warp is not None:
        return output.warp.slope(*output.target(x))
    return output.amplitude(x) if output.feature_map.rates else None


def _weight_of_difference(output: OutputModel, x: Tensor) -> Tensor | None:
    """Return the weights (r,) of reference points x (r, d) that grow with the squared slope of the output's mean, which
    is the difference from the prior model to which it is added; None if it is added to none."""
    if output.size_with_prior is None or not len(x):
        return None
    with torch.inference_mode(False), torch.enable_grad():
        at = x.clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(output.mean(at).sum(), at)
    square = slope.square().sum(-1)
    return 1 + DIFFERENCE * square / square.mean().clamp_min(SMALLEST)


def as_if_answered(output: OutputModel, x: Tensor) -> OutputModel:
    """Condition an output on k assumed observations at inputs x (k, d), each equal to the mean there: variances
    decrease, means stay."""
    if (posterior := output.posterior) is not None:
        for point in x:
            posterior = posterior.extend(point, posterior.mean(point[None])[0])
    return replace(output, posterior=posterior)


def _log_determinants(covariance: Tensor, weight: Tensor) -> Tensor:
    """Return 1/2 log det(I + W S W) of the first t points of each of b paths, for t = 1 to T, (b, T).

    Args:
        covariance: covariance S of the points of each path, (b, T, T).
        weight: diagonal of the diagonal matrix W of each path, (b, T).
    """
    one = torch.eye(weight.shape[1], dtype=weight.dtype)
    matrix = one + weight[:, :, None] * covariance * weight[:, None, :]
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool((wrong := failed > 0).any()):  # large weights scale up rounding errors, or a path is not finite
        finite = matrix[wrong].nan_to_num(nan=1.0, posinf=1.0, neginf=1.0)
        lacking = (1 - torch.linalg.eigvalsh(finite)[:, :1, None]).clamp_min(0.0)
        factor[wrong] = torch.linalg.cholesky(finite + lacking * one)
    gained: Tensor = factor.diagonal(dim1=-2, dim2=-1).log().cumsum(-1)
    return gained
