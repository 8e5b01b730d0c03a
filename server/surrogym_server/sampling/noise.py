"""Distinguish noise of the original environment from misfit of the model, by steps that are taken twice.

A Gaussian process that does not fit its samples explains the residuals as noise. Only a repetition of the same step
distinguishes misfit from noise: a deterministic environment gives the same result. Repeated steps are few, so each
conclusion is a chi-squared test, at the level ``LEVEL``, of the sum of the squared differences of their results from
their mean. Steps are repeated until each output with large learned noise has a conclusion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import scipy  # SciPy imports its submodules on first use, so a server that needs none of them starts sooner
import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples, increments, preceding, saturated
from surrogym_server.models.abilities import LearnedNoise, LeaveOneOut, offers
from surrogym_server.models.port import DynamicsModel

ENOUGH = 3  # noise is confirmed only after at least this many repetitions of earlier steps
STAGES = (1, ENOUGH, 6, 9)  # a test for noise follows when this many earlier steps have been repeated
LEVEL = 0.01  # significance level of each test for noise
NEGLIGIBLE = 0.5  # true noise below this share of the tolerance is confirmed with probability ``LEVEL`` at most
# If a model has learned noise of more than this multiple of that of repeated steps, the excess is misfit, not noise.
AT_MOST = 3.0
SLACK = 1.25  # if an output has confirmed noise, a leave-one-out error up to this many times its tolerance is accepted


@dataclass(frozen=True)
class Repeats:
    """Differences between the results of steps that were taken several times (repeats), pooled over all such steps."""

    degrees: int  # degrees of freedom: number of samples less the number of different steps among them
    std: Tensor  # (O,) standard deviation of an output's values at the same step, in the output's unit


def repeats(model: DynamicsModel, samples: Samples) -> Repeats:
    """Compute the differences between the results of steps that were taken several times, pooled over all such steps.

    Samples are results of the same step if their states and actions are equal. In an environment that can't be set to
    any state, the states and actions of the steps before must be equal too; otherwise the influence of hidden state
    would count as noise.
    """
    targets = torch.cat([increments(model.definition, samples), samples.reward[:, None]], -1)
    groups, member = torch.unique(_conditions(model.definition, samples), dim=0, return_inverse=True)
    counts = torch.bincount(member, minlength=len(groups)).to(targets.dtype)
    means = torch.zeros(len(groups), targets.shape[1], dtype=targets.dtype).index_add(0, member, targets)
    within = (targets - (means / counts[:, None])[member]).square().sum(0)
    degrees = len(samples) - len(groups)
    return Repeats(degrees, (within / max(degrees, 1)).sqrt())


def _conditions(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    """Return the quantities that may determine the result of each of n steps, (n, d): its state and action, and those
    of the step before.

    The first step of an episode has zeros for the step before. If the environment can be set to any state, the step
    before is left out, because it does not influence the result.
    """
    now = torch.cat([samples.q, samples.u], -1)
    if definition.max_rollout is None:
        return now
    follows = preceding(definition, samples)
    began = (follows < 0)[:, None]
    return torch.cat([now, torch.where(began, 0.0, now[follows]), began.to(now.dtype)], -1)


def established_noise(model: DynamicsModel, samples: Samples, tolerances: Sequence[float]) -> Tensor:
    """Return the standard deviation of each output's noise that repeated steps confirm, in the output's unit, (O,).

    It is 0 if repeated steps confirm no noise, or if the noise that the model has learned is within the tolerance.
    """
    model_noise, limits = _model_noise(model, tolerances)
    differences = repeats(model, samples)
    if differences.degrees < ENOUGH:
        return torch.zeros_like(model_noise)
    confirmed = (model_noise > limits) & _confirmed(differences, limits)
    return torch.where(confirmed, model_noise.minimum(AT_MOST * differences.std), 0.0)


def to_repeat(model: DynamicsModel, samples: Samples, tolerances: Sequence[float]) -> Points | None:
    """Return earlier steps (states and actions) that should be taken again to tell noise from misfit of the model; None
    if none are needed.

    Repetitions are needed if noise above a tolerance could explain the samples, and repeated steps have neither
    confirmed nor refuted this noise. First one step is repeated, which suffices to refute noise if the environment is
    deterministic. Further repetitions follow until their number is the next one in the list ``STAGES``. An output is
    also tested again if its confirmed noise does not explain its leave-one-out error, because few repetitions may show
    too little noise. Steps that ended at a bound are not repeated, because the bound hides noise.
    """
    model_noise, limits = _model_noise(model, tolerances)
    differences = repeats(model, samples)
    if not differences.degrees and not bool((model_noise > limits).any()):
        model_noise = _possible(model, limits)
    doubtful = model_noise > limits
    if differences.degrees:
        doubtful &= ~_refuted(differences, model_noise)
    if differences.degrees >= ENOUGH:
        noise = established_noise(model, samples, tolerances)
        doubtful &= ~_confirmed(differences, limits) | _unexplained(model, limits, noise)
    following = next((stage for stage in STAGES if stage > differences.degrees), None)
    if following is None or not bool(doubtful.any()):
        return None
    definition = model.definition
    free = definition.can_be_set(samples.q) & ~saturated(definition, samples.q_next)
    which = free.nonzero()[differences.degrees : following, 0]
    return Points(samples.q[which], samples.u[which]) if len(which) else None


def _confirmed(differences: Repeats, limits: Tensor) -> Tensor:
    """Return (O,) bool: for each output, whether repeated steps show that its noise exceeds ``NEGLIGIBLE`` (0.5) times
    its tolerance in ``limits`` (O,)."""
    bound = (NEGLIGIBLE * limits).square() * float(scipy.special.chdtri(differences.degrees, LEVEL))
    return differences.degrees * differences.std.square() > bound


def _unexplained(model: DynamicsModel, limits: Tensor, noise: Tensor) -> Tensor:
    """Return (O,) bool: for each output, whether its leave-one-out error exceeds 1.25 sqrt(tolerance^2 + noise^2), with
    its tolerance in ``limits`` (O,) and its ``noise`` (O,)."""
    able = offers(model, LeaveOneOut)
    if able is None:
        return torch.zeros_like(noise, dtype=torch.bool)
    errors = torch.tensor([one.error for one in able.leave_one_out()], dtype=noise.dtype)
    return errors > SLACK * torch.hypot(limits, noise)


def _refuted(differences: Repeats, model_noise: Tensor) -> Tensor:
    """Return (O,) bool: for each output, whether repeated steps show that most of the noise that the model has learned,
    ``model_noise`` (O,), is misfit of the model."""
    bound = (model_noise / AT_MOST).square() * float(scipy.special.chdtri(differences.degrees, 1 - LEVEL))
    return differences.degrees * differences.std.square() <= bound


def widened_by(noise: Tensor, tolerances: Sequence[float]) -> tuple[float, ...]:
    """Return the tolerances (O,), increased by the confirmed noise (O,): sqrt(tolerance^2 + noise^2). The error of a
    prediction of a noisy output can't be smaller than the noise."""
    return tuple(math.hypot(tolerance, float(one)) for tolerance, one in zip(tolerances, noise, strict=True))


def _possible(model: DynamicsModel, limits: Tensor) -> Tensor:
    """Return the largest noise (O,) of each output with which the samples are at least as likely as with the noise that
    the model has learned."""
    able = offers(model, LearnedNoise)
    return torch.zeros_like(limits) if able is None else torch.tensor(able.possible_noise, dtype=limits.dtype)


def _model_noise(model: DynamicsModel, tolerances: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Return two tensors: the standard deviation (O,) of each output's noise that a model has learned, and the
    ``tolerances`` (O,)."""
    limits = torch.tensor(list(tolerances), dtype=torch.float64)
    able = offers(model, LearnedNoise)
    if able is None:
        return torch.zeros_like(limits), limits
    return torch.tensor(able.noise_stds, dtype=limits.dtype), limits
