"""Limits within which the original environment has to stay: the rules of ``surrogym_shared.limits``, on tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.terms import TermSet, compile_terms
from surrogym_server.tensors import CPU, to_device
from surrogym_shared.spec import Limit, ends_of


@dataclass(frozen=True)
class LimitSet:
    """L limits, compiled to tensors that evaluate them for many states at once."""

    terms: TermSet
    low: Tensor  # (L,) lower end of the range in which each of L terms has to stay
    high: Tensor  # (L,) upper end of the range in which each of L terms has to stay
    margin: Tensor  # (L,) a declared fallback action takes over if a term is closer than this to an end of its range

    @classmethod
    def of(cls, keep: Sequence[Limit], names: Sequence[str], device: torch.device = CPU) -> LimitSet:
        """Compile limits over the C coordinates ``names`` on a device."""
        terms = compile_terms([limit.term for limit in keep], names)
        rows = [(*ends_of(limit.low, limit.high), limit.margin) for limit in keep]
        low, high, margin = torch.tensor(rows, dtype=torch.float64).T.contiguous().unbind()
        return to_device(cls(terms, low, high, margin), device)

    def room(self, q: Tensor) -> Tensor:
        """Return for L declared limits, each a range of a function of the state, how far states q (..., C) are from the
        nearer end of the range, (..., L). The distance is negative outside the range."""
        value = self.terms(q)
        return torch.minimum(value - self.low, self.high - value)

    def falls_back(self, q: Tensor, q_next: Tensor) -> Tensor:
        """Return whether the fallback action takes over after a step from q (..., C) to q_next (..., C), (...) bool. It
        does if the distance to an end of a limit is below the limit's margin at q_next, or would be after one more step
        in which the distance changes as much as in this one: the rule of ``surrogym_shared.limits.is_near``."""
        now = self.room(q_next)
        return (torch.minimum(now, 2 * now - self.room(q)) < self.margin).any(-1)
