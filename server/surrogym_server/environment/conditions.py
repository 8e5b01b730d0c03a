"""Groups of inequalities between terms (functions of the coordinates) and numbers. A group holds if all of its
inequalities hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.terms import TermSet, compile_terms
from surrogym_server.tensors import CPU, to_device
from surrogym_shared.spec import Inequality


@dataclass(frozen=True)
class Conditions:
    """Compiled conditions: G groups with K inequalities in total. A group holds if all of its inequalities hold. Each
    inequality is stored as sign * term >= threshold, which is also exact for < and >."""

    terms: TermSet  # the left side of each of the K inequalities, a function of the coordinates
    sign: Tensor  # (K,) 1 for an inequality with > or >=, -1 for one with < or <=
    threshold: Tensor  # (K,) the inequality holds if sign * term is at least this number
    membership: Tensor  # (K, G) 1 if the inequality of this row belongs to the group of this column, otherwise 0

    @classmethod
    def of(cls, groups: Sequence[Sequence[Inequality]], names: Sequence[str], device: torch.device = CPU) -> Conditions:
        """Compile groups of inequalities over the C coordinates ``names``. An empty group always holds."""
        inequalities = [i for group in groups for i in group]
        belongs = [g for g, group in enumerate(groups) for _ in group]
        sign = np.array([1.0 if i.relation in (">", ">=") else -1.0 for i in inequalities])
        bound = sign * np.array([i.value for i in inequalities])
        strict = np.array([i.relation in ("<", ">") for i in inequalities], dtype=bool)
        threshold = np.where(strict, np.nextafter(bound, np.inf), bound)
        membership = np.eye(len(groups))[belongs].reshape(len(inequalities), len(groups))
        terms = compile_terms([i.term for i in inequalities], names)
        compiled = cls(terms, *(torch.from_numpy(array) for array in (sign, threshold, membership)))
        return to_device(compiled, device)

    def __call__(self, q: Tensor) -> Tensor:
        """Return (..., G) bool: which of the G groups of inequalities hold at coordinates q (..., C)."""
        holds = self.sign * self.terms(q) >= self.threshold
        return (~holds).to(self.membership.dtype) @ self.membership == 0
