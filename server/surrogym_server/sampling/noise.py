"""Noise of the original environment, told from a model's misfit by steps that are taken twice.

A process that does not fit its samples calls the rest noise. Only the same step, taken again, shows which it is: a
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
AT_MOST = 3.0  # measured deviations: more of the learned noise is misfit, whatever the chance of few repeats
REFUTED = 0.05  # of the learned noise: where repeats differ by less, it is misfit
SLACK = 1.25  # a leave-one-out error beyond the noise that few samples leave


@dataclass(frozen=True)
class Repeats:
    """How far results of the same step differ."""

    degrees: int  # of freedom
    deviation: Tensor  # (O,) of one result, in each output's unit


def repeats(model: DynamicsModel, samples: Samples) -> Repeats:
    """Deviations of repeated steps in the samples, pooled."""
    targets = torch.cat([increments(model.definition, samples), samples.reward[:, None]], -1)
    groups, member = torch.unique(torch.cat([samples.q, samples.u], -1), dim=0, return_inverse=True)
    counts = torch.bincount(member, minlength=len(groups)).to(targets.dtype)
    means = torch.zeros(len(groups), targets.shape[1], dtype=targets.dtype).index_add(0, member, targets)
    within = (targets - (means / counts[:, None])[member]).square().sum(0)
    degrees = len(samples) - len(groups)
    return Repeats(degrees, (within / max(degrees, 1)).sqrt())


def established_noise(model: DynamicsModel, samples: Samples, tolerances: Sequence[float]) -> Tensor:
    """Deviation of each output's noise that repeated steps confirm, in its unit, (O,): 0 where there is none, or it
    lies below the tolerance."""
    learned, limits = _learned(model, tolerances)
    found = repeats(model, samples)
    if found.degrees < ENOUGH:
        return torch.zeros_like(learned)
    confirmed = (learned > limits) & (found.deviation > limits)
    return torch.where(confirmed, learned.minimum(AT_MOST * found.deviation), 0.0)


def to_repeat(model: DynamicsModel, samples: Samples, tolerances: Sequence[float]) -> Points | None:
    """Steps to take again, where a model has learned noise beyond a tolerance and nobody has tried whether that is so:
    one first, which refutes it in a deterministic environment, and then as many as are ``ENOUGH``. None if none."""
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
    """Tolerances (O,) with the established noise (O,): what varies by itself can't be known better."""
    return tuple(math.hypot(tolerance, float(one)) for tolerance, one in zip(tolerances, noise, strict=True))


def _learned(model: DynamicsModel, tolerances: Sequence[float]) -> tuple[Tensor, Tensor]:
    """The noise that a model has learned, and the tolerances, (O,) each."""
    limits = torch.tensor(list(tolerances), dtype=torch.float64)
    able = offers(model, LearnedNoise)
    if able is None:
        return torch.zeros_like(limits), limits
    return torch.tensor(able.noise_deviations, dtype=limits.dtype), limits
