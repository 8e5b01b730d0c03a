"""Inequalities over terms, in groups. A group holds if all its inequalities hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.terms import TermDefinition, TermSet, compile_terms
from surrogym_server.tensors import CPU, to_device
from surrogym_shared.kinds import Relation


@dataclass(frozen=True)
class InequalityDefinition:
    """Condition ``term relation value``."""

    term: TermDefinition
    relation: Relation
    value: float


@dataclass(frozen=True)
class Conditions:
    """G groups of K inequalities in all, compiled: each one as sign * term >= threshold, exactly."""

    terms: TermSet
    sign: Tensor  # (K,)
    threshold: Tensor  # (K,)
    membership: Tensor  # (K, G)

    @classmethod
    def of(
        cls, groups: Sequence[Sequence[InequalityDefinition]], coordinates: int, device: torch.device = CPU
    ) -> Conditions:
        """Compile groups over C coordinates on a device. An empty group always holds."""
        inequalities = [i for group in groups for i in group]
        belongs = [g for g, group in enumerate(groups) for _ in group]
        sign = np.array([1.0 if i.relation in (">", ">=") else -1.0 for i in inequalities])
        bound = sign * np.array([i.value for i in inequalities])
        strict = np.array([i.relation in ("<", ">") for i in inequalities], dtype=bool)
        threshold = np.where(strict, np.nextafter(bound, np.inf), bound)
        membership = np.eye(len(groups))[belongs].reshape(len(inequalities), len(groups))
        terms = compile_terms([i.term for i in inequalities], coordinates)
        compiled = cls(terms, *(torch.from_numpy(array) for array in (sign, threshold, membership)))
        return to_device(compiled, device)

    def __call__(self, q: Tensor) -> Tensor:
        """Which groups hold at q (..., C), (..., G)."""
        holds = self.sign * self.terms(q) >= self.threshold
        return (~holds).to(self.membership.dtype) @ self.membership == 0
