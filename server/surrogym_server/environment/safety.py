"""Limits that the original environment keeps, as ``surrogym_shared.limits`` computes them, on tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.terms import TermDefinition, TermSet, compile_terms
from surrogym_server.tensors import CPU, to_device


@dataclass(frozen=True)
class LimitDefinition:
    """Range [low, high] of a term; within ``margin`` of an end the fallback acts."""

    term: TermDefinition
    low: float
    high: float
    margin: float


@dataclass(frozen=True)
class LimitsDefinition:
    """L limits, and the share of episodes that may leave one."""

    keep: tuple[LimitDefinition, ...]
    probability: float


@dataclass(frozen=True)
class Limits:
    """L limits, compiled."""

    terms: TermSet
    low: Tensor  # (L,)
    high: Tensor  # (L,)
    margin: Tensor  # (L,)

    @classmethod
    def of(cls, declared: LimitsDefinition, coordinates: int, device: torch.device = CPU) -> Limits:
        """Compile limits over C coordinates on a device."""
        terms = compile_terms([limit.term for limit in declared.keep], coordinates)
        rows: Sequence[tuple[float, ...]] = [(limit.low, limit.high, limit.margin) for limit in declared.keep]
        low, high, margin = torch.tensor(rows, dtype=torch.float64).T.contiguous().unbind()
        return to_device(cls(terms, low, high, margin), device)

    def room(self, q: Tensor) -> Tensor:
        """Distance from states q (..., C) to the nearer end of each limit, (..., L); negative beyond it."""
        value = self.terms(q)
        return torch.minimum(value - self.low, self.high - value)

    def falls_back(self, q: Tensor, q_next: Tensor) -> Tensor:
        """Whether the room of a limit is below its margin at q_next (..., C), or would be after one more step with the
        change from q (..., C) to q_next: (...) bool."""
        now = self.room(q_next)
        return (torch.minimum(now, 2 * now - self.room(q)) < self.margin).any(-1)
