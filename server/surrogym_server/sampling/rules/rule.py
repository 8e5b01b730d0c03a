"""The signature of a rule, and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from surrogym_server.environment.points import Points
from surrogym_server.sampling.rollouts import Rollout
from surrogym_server.sampling.round import Round


@dataclass(frozen=True)
class Chosen:
    """Queries of a round: single steps, or rollouts."""

    points: Points | None = None
    rollouts: tuple[Rollout, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.points is not None and len(self.points)) or bool(self.rollouts)


Rule = Callable[[Round], Chosen | None]
"""Chooses queries, or none, which ends the design. It returns None if it does not apply: the next rule is asked."""
