"""One round of the design, in the form in which the rules that choose its queries use it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.judging import Judgement
from surrogym_server.sampling.seeds import generator_for
from surrogym_server.sampling.state import Request


@dataclass(frozen=True)
class Round:
    """The model of a round, its judgement, and the request that the round answers. O outputs."""

    number: int
    model: DynamicsModel
    samples: Samples
    request: Request
    judgement: Judgement
    tolerances: tuple[float, ...]  # (O,) declared or default tolerances, not widened by noise
    outputs: list[int]  # indices of the outputs to query for, the least confident first; at least one
    continues: bool  # whether the round may spend the rest of the budget; if not, it may take ``request.extra`` steps
    testing: bool  # whether the design is ready but for an excursion that tests its model

    @property
    def definition(self) -> EnvironmentDefinition:
        return self.model.definition

    @property
    def cost(self) -> int:
        """Number of real steps that count towards the budget."""
        return self.request.cost(len(self.samples))

    @property
    def room(self) -> int:
        """Number of real steps that the budget has left, less those that unanswered queries may take."""
        return max(0, self.request.budget - self.cost - self.request.pending_steps)

    @property
    def may_examine(self) -> bool:
        """Whether rules may spend steps on the causes of large errors.

        They may in the second half of the budget, once half as many adaptive queries as initial ones are answered. In
        preset ``paper`` they never may.
        """
        design = self.definition.design
        enough = self.cost >= max(self.request.budget / 2, 1.5 * design.initial)
        return self.continues and design.stopping == "tested_confidence" and enough

    def generator(self) -> np.random.Generator:
        """Return a new random generator for this round's rollouts; every call returns the same stream of numbers."""
        return generator_for(self.definition, f"rollouts {self.number}")
