"""States with actions, as inputs of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_shared.nouns import Query


@dataclass(frozen=True)
class Points:
    """m states, each with an action."""

    q: Tensor  # (m, C) coordinates of m states
    u: Tensor  # (m, F) the action in each of m states

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index: slice | Tensor | list[int]) -> Points:
        return Points(self.q[index], self.u[index])

    @classmethod
    def of(cls, definition: EnvironmentDefinition, queries: Sequence[Query]) -> Points:
        """Return the states and actions of queries, each for a single step."""
        q = torch.tensor([query.coordinates for query in queries], dtype=torch.float64)
        u = torch.tensor([query.action for query in queries], dtype=torch.float64)
        return cls(q.reshape(-1, len(definition.coordinates)), u.reshape(-1, definition.action.size))

    @property
    def queries(self) -> tuple[Query, ...]:
        """One query for each point: a single step from its state under its action."""
        return tuple(Query.step(*step) for step in zip(self.q.tolist(), self.u.tolist(), strict=True))

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        return cls(torch.cat([p.q for p in parts]), torch.cat([p.u for p in parts]))
