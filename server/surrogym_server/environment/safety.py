"""Limits within which the original environment has to stay: the rules of ``surrogym_shared.limits``, on tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.terms import TermDefinition, TermSet, compile_terms
from surrogym_server.tensors import CPU, to_device


@dataclass(frozen=True)
class LimitDefinition:
    """One limit: the range [low, high] of a term. Within ``margin`` of an end, the fallback action takes over."""

    term: TermDefinition
    low: float
    high: float
    margin: float


@dataclass(frozen=True)
class LimitsDefinition:
    """L limits, and the share ``probability`` of episodes that may leave one of them."""

    keep: tuple[LimitDefinition, ...]
    probability: float


@dataclass(frozen=True)
class Limits:
    """L limits in the form in which they are computed for many states at once."""

    terms: TermSet
    low: Tensor  # (L,) lower end of each limit
    high: Tensor  # (L,) upper end of each limit
    margin: Tensor  # (L,) margin of each limit, in the unit of its term

    @classmethod
    def of(cls, declared: LimitsDefinition, coordinates: int, device: torch.device = CPU) -> Limits:
        """Compile limits over C coordinates on a device."""
        terms = compile_terms([limit.term for limit in declared.keep], coordinates)
        rows: Sequence[tuple[float, ...]] = [(limit.low, limit.high, limit.margin) for limit in declared.keep]
        low, high, margin = torch.tensor(rows, dtype=torch.float64).T.contiguous().unbind()
        return to_device(cls(terms, low, high, margin), device)

    def room(self, q: Tensor) -> Tensor:
        """Return the distance of states q (..., C) to the nearer end of each limit, (..., L); negative beyond it."""
        value = self.terms(q)
        return torch.minimum(value - self.low, self.high - value)

    def falls_back(self, q: Tensor, q_next: Tensor) -> Tensor:
        """Return whether the distance to a limit is below its margin at q_next (..., C), or would be so after one more
        step with the same change as from q (..., C) to q_next: (...) bool."""
        now = self.room(q_next)
        return (torch.minimum(now, 2 * now - self.room(q)) < self.margin).any(-1)
