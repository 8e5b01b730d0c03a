"""Inputs of a round of the design: the state that the previous round returned, and the request for this round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.surprises import Surprises
from surrogym_server.sampling.tolerances import DefaultTolerances
from surrogym_shared.nouns import Query, Vector


@dataclass(frozen=True)
class Conditions:
    """Conditions under which a design with O outputs has ended. If they change later, the design may continue."""

    cost: float  # number of real steps taken that count towards the budget
    budget: float  # greatest number of real steps that the design may take
    target: float  # confidence index that every output has to reach
    tolerances: tuple[float, ...]  # (O,) declared or default tolerance of each output

    def to_list(self) -> list[float]:
        """Return the conditions as one list, for JSON."""
        return [float(self.cost), float(self.budget), self.target, *self.tolerances]

    @classmethod
    def from_list(cls, numbers: Sequence[float]) -> Conditions:
        cost, budget, target, *tolerances = numbers
        return cls(cost, budget, target, tuple(tolerances))


@dataclass(frozen=True)
class DesignState:
    """State that one round passes to the next. It can be stored as JSON."""

    round: int = 0
    # Default tolerances, for outputs without a declared tolerance.
    defaults: DefaultTolerances = field(default_factory=DefaultTolerances)
    warm: dict[str, NDArray[np.float64]] = field(default_factory=dict)  # values at which the next fit of a model starts
    ended_under: Conditions | None = None  # conditions when the design ended; None while it continues
    ended_as: str = ""  # the verdict with which the design ended; "" while it continues
    # Number of real steps that counted towards the budget when the last excursion was planned: an action sequence that
    # tests a model which satisfies the stopping rule; 0 if none was planned since a model last failed the rule.
    tested_at: float = 0

    def to_json(self) -> dict[str, Any]:
        warm = {key: array.tolist() for key, array in self.warm.items()}
        usual, ranges = list(self.defaults.values), list(self.defaults.ranges)
        conditions = [] if self.ended_under is None else self.ended_under.to_list()
        fields = {"round": self.round, "usual": usual, "ranges": ranges, "warm": warm, "ended_with": conditions}
        return fields | {"ended_as": self.ended_as, "tested_at": self.tested_at}

    @classmethod
    def from_json(cls, state: dict[str, Any]) -> DesignState:
        warm = {key: np.array(array) for key, array in state.get("warm", {}).items()}
        defaults = DefaultTolerances(tuple(state.get("usual", ())), tuple(state.get("ranges", ())))
        conditions = state.get("ended_with")
        return cls(
            round=state.get("round", 0),
            defaults=defaults,
            warm=warm,
            ended_under=Conditions.from_list(conditions) if conditions else None,
            ended_as=state.get("ended_as", ""),
            tested_at=state.get("tested_at", 0),
        )


@dataclass(frozen=True)
class Request:
    """Input of one round of the design: its budget and target, and what has happened to its queries.

    Steps of pending queries are reserved: ``cost`` does not count them, but ``Round.room`` subtracts them from the
    budget, so that a design whose queries all fail comes to an end. Refused queries need no budget, because no real
    step was taken. The acquisition computes standard deviations as if pending and refused queries had been answered, so
    that the next queries are chosen elsewhere.
    """

    budget: int  # greatest number of real steps that the design may take
    target: float  # confidence index that every output has to reach
    pending: tuple[Query, ...] = ()  # queries without an answer, including those set aside after repeated failures
    refused: tuple[Query, ...] = ()  # queries that the original environment refused
    extra: int = 0  # if the design has ended, this many further real steps are requested
    states: Tensor | None = None  # (v, C) states that policies visited
    # Coordinates (C,) of each state to which the environment can return (snapshot), by the snapshot's name.
    snapshots: Mapping[str, Vector] = field(default_factory=dict)
    logged: int = 0  # number of samples that come from a log of earlier steps
    audited: int = 0  # number of samples that come from audits (tests of trained policies)
    unlearned: int = 0  # number of real steps that are not among the samples, because lags (past values) were not known
    open: int = 0  # number of real steps of the pending queries that may still be answered, without those set aside
    prior: DynamicsModel | None = None  # model of what is known beforehand, such as a model of a simulator
    surprises: Surprises = ()  # errors of this round's new samples, by the previous model

    def cost(self, samples: int) -> int:
        """Return the number of real steps that count towards the budget of a design with this number of ``samples``.

        Samples from logs and audits don't count. Steps at which lags (past values) were not known do count, although
        they are not among the samples.
        """
        return samples - self.logged - self.audited + self.unlearned

    @property
    def unanswered(self) -> tuple[Query, ...]:
        """All queries without an answer, pending or refused. The acquisition computes standard deviations as if they
        had been answered."""
        return (*self.pending, *self.refused)

    @property
    def pending_steps(self) -> int:
        """Number of real steps of the pending queries."""
        return sum(query.steps for query in self.pending)

    def is_mostly_refused(self, cost: float) -> bool:
        """Return whether the design should end because the environment refused too many steps: at least as many as the
        budget plus ``cost``, the number of real steps taken that count towards the budget.

        Without this limit, a design whose queries are all refused would never end.
        """
        return sum(query.steps for query in self.refused) >= self.budget + cost
