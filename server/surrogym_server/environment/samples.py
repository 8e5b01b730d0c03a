"""Samples: the real steps from which a model learns."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from surrogym_server.environment.angle_unwrapping import angle_increments
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_shared.nouns import RealSteps


@dataclass(frozen=True)
class Samples:
    """n steps of the original environment, as float64 tensors."""

    q: Tensor  # (n, C) coordinates before each of n steps
    u: Tensor  # (n, F) action of each of n steps
    q_next: Tensor  # (n, C) coordinates after each of n steps
    reward: Tensor  # (n,) reward of each step
    terminated: Tensor  # (n,) bool: whether the step reached a terminal state

    def __len__(self) -> int:
        return len(self.q)

    @classmethod
    def of(cls, steps: RealSteps) -> Self:
        """Return real steps as tensors that share the memory of their arrays."""
        columns = (steps.coordinates, steps.action, steps.next_coordinates, steps.reward, steps.terminated)
        return cls(*map(torch.from_numpy, columns))

    def at(self, rows: Tensor) -> Samples:
        """Return the samples with the indices ``rows``, or those that a mask (n,) selects."""
        return Samples(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def digest(self) -> str:
        """SHA-256 hash of all arrays. Equal digests mean that the samples are equal, byte for byte."""
        sha = hashlib.sha256()
        for tensor in (self.q, self.u, self.q_next, self.reward, self.terminated):
            sha.update(tensor.cpu().contiguous().numpy().tobytes())
        return sha.hexdigest()


def increments(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    """Return the changes in n steps that a model learns to predict: those of the M moving coordinates, (n, M), with the
    full turns of angles. If the model predicts observations (preset ``paper``), those of the D entries, (n, D)."""
    if definition.moves_observation:
        return definition.observe(samples.q_next) - definition.observe(samples.q)
    change = samples.q_next - samples.q
    change[:, definition.angles] = angle_increments(definition, samples.q, samples.q_next)
    return change[:, definition.moving]


def preceding(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    """Return for each of n samples the row (n,) of the sample that is the step before it; -1 if there is none.

    This is the previous row, if its step did not terminate and the sample begins at the moving coordinates at which
    the step ended.
    """
    columns = list(definition.moving)
    follows = torch.full((len(samples),), -1)
    same = (samples.q[1:, columns] == samples.q_next[:-1, columns]).all(-1) & ~samples.terminated[:-1]
    follows[1:] = torch.where(same, torch.arange(len(same)), -1)
    return follows


def saturated(definition: EnvironmentDefinition, q_next: Tensor) -> Tensor:
    """Return (n,) bool: which of n steps, which ended at q_next (n, C), reached a declared bound of any coordinate. The
    change in such a step is shorter than the dynamics alone would give."""
    return (limit_sides(definition, q_next) != 0).any(-1)


def limit_sides(definition: EnvironmentDefinition, q_next: Tensor) -> Tensor:
    """Return a number (n, C) for each coordinate of n states q_next (n, C): 1 at its upper bound, -1 at its lower
    bound, otherwise 0."""
    low, high = definition.bounds
    slack = 1e-9 * torch.where(torch.isfinite(high - low), high - low, 1.0)
    return (q_next >= high - slack).to(q_next.dtype) - (q_next <= low + slack).to(q_next.dtype)
