"""Distinguish noise of the sensors from noise of the process, by consecutive steps of one episode.

A sensor's error v falsifies the end of one step and the start of the next: if s_t + v_t is measured for the state s_t,
the residual of a step is r_t = v_{t+1} - a_t v_t + w_t, where a_t is the derivative of the next state with respect to
the state and w_t the noise of the process. So residuals of neighbouring steps have the covariance -a_t var(v) by sensor
noise, and none by process noise.

The residuals of a learned function are not only noise: its errors at neighbouring states are similar. So the test
compares Gaussian processes whose noise has the covariance

    c s^2 ((1 - share) I + share S),  S_tt ~ 1 + a_t^2,  S_{t-1,t} ~ -a_t,  mean diagonal of S 1,

where s^2 is the learned variance of the noise, c a factor near 1, and share the part that comes from the sensor. The
statistic is the likelihood ratio of the best share against a share of 0. Because 0 lies at the edge of the allowed
shares, half the chi-squared distribution of one degree of freedom applies (Self and Liang 1987).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.samples import Samples, preceding
from surrogym_server.models.abilities import AtSamples, LearnedNoise, SampledFunctions, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_shared.spec import limits

FEWEST = 12  # the test for sensor noise needs at least this many pairs of consecutive steps
MOST = 256  # greatest number of samples in the test for sensor noise, whose time grows with their third power
CRITICAL = 5.41  # upper 2 % point of chi-squared with one degree of freedom: the one-sided test has level 1 %
MAINLY = 0.5  # if at least this share of the noise comes from the sensor, it counts as sensor noise
SHARES = torch.linspace(0, 1, 21, dtype=torch.float64)  # shares of the noise that are tried as noise of the sensor
# The learned noise variance is tried times each of these factors c.
FACTORS = torch.logspace(-0.6, 0.6, 9, dtype=torch.float64)
# Measurement errors at the start of a step cause noise in the predicted output. This noise is computed with derivatives
# of the model, which has errors, so its standard deviation is multiplied by this safety factor.
CARRIED = 1.25
DIFFERENCE = 1e-4  # step of the numerical derivatives with respect to a coordinate, as a share of its sampling range


@dataclass(frozen=True)
class SensorNoise:
    """Estimated noise of the sensor that measures the coordinate of one output."""

    share: float  # share of the variance of a step's noise that comes from the sensor
    std: float  # standard deviation of one measurement, in the output's unit
    step: float  # standard deviation of a single step's noise from all sources, in the output's unit


def sensor_noise(model: DynamicsModel, samples: Samples, limits: Sequence[float]) -> tuple[SensorNoise | None, ...]:
    """Estimate, for each of the O outputs, the noise of the sensor that measures its coordinate.

    The entry is None for an output whose learned noise is within its tolerance in ``limits`` (O,), or if consecutive
    steps don't show that most of this noise comes from the sensor. It is None for the reward.
    """
    definition, able = model.definition, offers(model, SampledFunctions)
    follows = preceding(definition, samples)
    if able is None or definition.moves_observation or int((follows >= 0).sum()) < FEWEST:
        return (None,) * len(definition.outputs)
    chained = (follows >= 0) | torch.isin(torch.arange(len(follows)), follows)
    some = samples.at(chained.nonzero()[:MOST, 0])
    result: list[SensorNoise | None] = []
    for column, index in enumerate(definition.moving):
        at = able.at_samples(some, column)
        exceeds = at is not None and math.sqrt(at.noise_variance) > limits[column]
        result.append(
            _sensor_noise(at, preceding(definition, some), _slopes(model, some, column, index))
            if at and exceeds
            else None
        )
    return (*result, None)


def noise_of_sensors(
    model: DynamicsModel, samples: Samples, sensors: Sequence[SensorNoise | None], limits: Sequence[float]
) -> Tensor:
    """Return the standard deviation of the noise in each output that comes from sensors, (O,), in the output's unit.

    If the output's own sensor is noisy, this is the whole noise of a single step of this output. Otherwise it is the
    noise that results from measurement errors in the state at the start of a step. A value within the tolerance in
    ``limits`` (O,) counts as 0.
    """
    if not any(sensors):
        return torch.zeros(len(sensors), dtype=torch.float64)
    model_noise = _model_noise(model)
    own = model_noise.minimum(model_noise.new_tensor([0.0 if one is None else one.step for one in sensors]))
    noise = torch.where(own > 0, own, model_noise.minimum(_carried(model, samples, sensors)))
    return torch.where(noise > noise.new_tensor(limits), noise, 0.0)


def _carried(model: DynamicsModel, samples: Samples, sensors: Sequence[SensorNoise | None]) -> Tensor:
    """Return the standard deviation of each output (O,) that results from measurement errors in the state at the start
    of a step."""
    variance = torch.zeros(len(sensors), dtype=torch.float64)
    for index, sensor in zip(model.definition.moving, sensors, strict=False):
        if sensor is not None:
            variance += sensor.std**2 * _differences(model, samples, index).square().mean(0)
    return CARRIED * variance.sqrt()


def _model_noise(model: DynamicsModel) -> Tensor:
    """Return the standard deviation of the noise that the model has learned for each output, (O,)."""
    able = offers(model, LearnedNoise)
    result = [0.0] * len(model.definition.outputs) if able is None else able.noise_stds
    return torch.tensor(result, dtype=torch.float64)


def _sensor_noise(at: AtSamples, follows: Tensor, slope: Tensor) -> SensorNoise | None:
    """Test whether most of the noise of one output comes from its sensor. Return the estimated noise, or None if the
    test does not show it.

    Args:
        at: values of the output at its samples, and covariance of its process.
        follows: (n,) index of the sample that is the step before each of the n samples; -1 if there is none.
        slope: (n,) derivative of the next value of the output's coordinate with respect to its present value.
    """
    slope = slope[at.rows]
    pattern = sensor_pattern(slope, _among(follows, at.rows))
    share, factor, ratio = best_share(at.targets, at.covariance, at.noise_variance, pattern)
    if ratio <= CRITICAL or share < MAINLY:
        return None
    step = math.sqrt(factor * at.noise_variance)
    return SensorNoise(share, step * math.sqrt(share / float((1 + slope.square()).mean())), step)


def _among(follows: Tensor, rows: Tensor) -> Tensor:
    """Return ``follows`` (the index of the sample before each sample, or -1) for the samples ``rows`` only, with
    indices counted among ``rows``."""
    # One entry more than samples: the index -1, which means no step before, selects the last entry, which stays -1.
    places = torch.full((len(follows) + 1,), -1)
    places[rows] = torch.arange(len(rows))
    return places[follows[rows]]


def sensor_pattern(slope: Tensor, follows: Tensor) -> Tensor:
    """Return the covariance (n, n) between the results of n steps that sensor noise causes, divided by its mean
    diagonal.

    ``follows[i]`` is the index of the step before step i, or -1 if there is none. ``slope[i]`` is the derivative of the
    next value of the coordinate with respect to its present value in step i.
    """
    pattern = torch.diag(1 + slope.square())
    later = (follows >= 0).nonzero()[:, 0]
    pattern[later, follows[later]] = pattern[follows[later], later] = -slope[later]
    return pattern / pattern.diagonal().mean()


def best_share(y: Tensor, function: Tensor, noise: float, pattern: Tensor) -> tuple[float, float, float]:
    """Fit the share of the noise that comes from the sensor, by maximum likelihood.

    Args:
        y: (n,) targets with mean 0.
        function: (n, n) prior covariance of the targets without noise.
        noise: variance of the noise of one step.
        pattern: (n, n) covariance between the results of the steps that sensor noise causes, from ``sensor_pattern``.

    Returns:
        The share, the factor by which ``noise`` has to be multiplied, and twice the difference in log likelihood from a
        share of 0.
    """
    likelihoods = torch.stack(
        [
            torch.stack([_log_likelihood(y, function + c * noise * _noise(pattern, share)) for c in FACTORS])
            for share in SHARES
        ]
    )
    best, at = likelihoods.max(1)
    place = int(best.argmax())
    return float(SHARES[place]), float(FACTORS[at[place]]), float(2 * (best[place] - best[0]))


def _noise(pattern: Tensor, share: Tensor) -> Tensor:
    return (1 - share) * torch.eye(len(pattern), dtype=pattern.dtype) + share * pattern


def _log_likelihood(y: Tensor, covariance: Tensor) -> Tensor:
    factor, info = torch.linalg.cholesky_ex(covariance)
    if bool(info):
        return y.new_tensor(-math.inf)
    white = torch.linalg.solve_triangular(factor, y[:, None], upper=False)
    likelihood: Tensor = -0.5 * white.square().sum() - factor.diagonal().log().sum()
    return likelihood


def _slopes(model: DynamicsModel, samples: Samples, column: int, index: int) -> Tensor:
    """Return the derivative of a coordinate's next value with respect to its present value at the samples, (n,).
    ``column`` is the index of its output, ``index`` that of the coordinate."""
    return 1 + _differences(model, samples, index)[:, column]


def _differences(model: DynamicsModel, samples: Samples, index: int) -> Tensor:
    """Return the derivatives of all outputs with respect to the coordinate with index ``index``, at the samples, (n,
    O)."""
    low, high = limits(model.definition.coordinates[index].sampling)
    step = torch.zeros_like(samples.q)
    step[:, index] = DIFFERENCE * max(high - low, 1e-12)
    above, below = (model.means(samples.q + sign * step, samples.u) for sign in (1, -1))
    return (above - below) / (2 * step[:, index : index + 1])
