"""States with actions, as inputs of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Points:
    """m states, each with an action."""

    q: Tensor  # (m, C)
    u: Tensor  # (m, F)

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index: slice | Tensor | list[int]) -> Points:
        return Points(self.q[index], self.u[index])

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        return cls(torch.cat([p.q for p in parts]), torch.cat([p.u for p in parts]))
