"""Tell noise of the original environment from misfit of the model, by steps that are taken twice.

A process that does not fit its samples explains the rest as noise. Only a repeat of the same step shows which it is: a
deterministic environment gives the same result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.models.abilities import LearnedNoise, offers
from surrogym_server.models.port import DynamicsModel

ENOUGH = 3  # degrees of freedom from repeated steps, before noise counts as established
AT_MOST = 3.0  # largest ratio of learned noise to measured deviation; the rest is misfit, even if there are few repeats
REFUTED = 0.05  # share of the learned noise; if repeats differ by less, the learned noise is misfit
SLACK = 1.25  # a leave-one-out error beyond the noise that few samples leave


@dataclass(frozen=True)
class Repeats:
    """Differences between results of the same step."""

    degrees: int  # of freedom
    deviation: Tensor  # (O,) of one result, in each output's unit


def repeats(model: DynamicsModel, samples: Samples) -> Repeats:
    """Pool the deviations of repeated steps in the samples."""
    targets = torch.cat([increments(model.definition, samples), samples.reward[:, None]], -1)
    groups, member = torch.unique(torch.cat([samples.q, samples.u], -1), dim=0, return_inverse=True)
    counts = torch.bincount(member, minlength=len(groups)).to(targets.dtype)
    means = torch.zeros(len(groups), targets.shape[1], dtype=targets.dtype).index_add(0, member, targets)
    within = (targets - (means / counts[:, None])[member]).square().sum(0)
    degrees = len(samples) - len(groups)
    return Repeats(degrees, (within / max(degrees, 1)).sqrt())


def established_noise(model: DynamicsModel, samples: Samples, tolerances: Sequence[float]) -> Tensor:
    """Deviation of each output's noise that repeated steps confirm, in its unit, (O,). It is 0 if there is none, or if
    it is below the tolerance."""
    learned, limits = _learned(model, tolerances)
    found = repeats(model, samples)
    if found.degrees < ENOUGH:
        return torch.zeros_like(learned)
    confirmed = (learned > limits) & (found.deviation > limits)
    return torch.where(confirmed, learned.minimum(AT_MOST * found.deviation), 0.0)


def to_repeat(model: DynamicsModel, samples: Samples, tolerances: Sequence[float]) -> Points | None:
    """Steps to take again, if a model has learned noise beyond a tolerance that no repeat has confirmed or refuted yet.

    First one step, which refutes the noise in a deterministic environment, then ``ENOUGH`` of them. None if none is
    needed.
    """
    learned, limits = _learned(model, tolerances)
    doubtful = learned > limits
    found = repeats(model, samples)
    if not bool(doubtful.any()) or found.degrees >= ENOUGH:
        return None
    if found.degrees and bool((found.deviation <= REFUTED * learned)[doubtful].all()):
        return None
    which = model.definition.can_be_set(samples.q).nonzero()[found.degrees : ENOUGH if found.degrees else 1, 0]
    return Points(samples.q[which], samples.u[which]) if len(which) else None


def widened(tolerances: Sequence[float], noise: Tensor) -> tuple[float, ...]:
    """Widen the tolerances (O,) by the established noise (O,), because a noisy output can't be known better than its
    noise."""
    return tuple(math.hypot(tolerance, float(one)) for tolerance, one in zip(tolerances, noise, strict=True))


def _learned(model: DynamicsModel, tolerances: Sequence[float]) -> tuple[Tensor, Tensor]:
    """The noise that a model has learned, and the tolerances, (O,) each."""
    limits = torch.tensor(list(tolerances), dtype=torch.float64)
    able = offers(model, LearnedNoise)
    if able is None:
        return torch.zeros_like(limits), limits
    return torch.tensor(able.noise_deviations, dtype=limits.dtype), limits
