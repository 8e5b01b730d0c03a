"""States with actions, as inputs of a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

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

    @property
    def queries_on_demand(self) -> Sequence[Query]:
        """The same queries, each made when it is read. A hundred thousand that exist at once make each full garbage
        collection of a server take more than 100 ms, in which nobody gets an answer."""
        return _OnDemand(self)

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        return cls(torch.cat([p.q for p in parts]), torch.cat([p.u for p in parts]))


AT_ONCE = 1_000  # number of queries that exist at once while all are read


@dataclass(frozen=True, eq=False)
class _OnDemand(Sequence[Query]):
    points: Points

    def __len__(self) -> int:
        return len(self.points)

    @overload
    def __getitem__(self, at: int) -> Query: ...
    @overload
    def __getitem__(self, at: slice) -> tuple[Query, ...]: ...
    def __getitem__(self, at: int | slice) -> Query | tuple[Query, ...]:
        if isinstance(at, slice):
            return self.points[at].queries
        return Query.step(self.points.q[at].tolist(), self.points.u[at].tolist())

    def __iter__(self) -> Iterator[Query]:
        for first in range(0, len(self), AT_ONCE):
            yield from self[first : first + AT_ONCE]
