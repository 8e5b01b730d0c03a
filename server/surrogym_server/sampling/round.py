"""One round of the design, as the rules that choose its queries see it."""

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
    tolerances: tuple[float, ...]  # (O,) declared or default ones, not widened by noise
    outputs: list[int]  # numbers of the outputs to query for, the least confident first; at least one
    continues: bool  # the round may spend what the budget has left; otherwise it may take ``request.extra`` steps
    testing: bool  # the design is ready, but an excursion tests its model first

    @property
    def definition(self) -> EnvironmentDefinition:
        return self.model.definition

    @property
    def cost(self) -> int:
        """Real steps that count towards the budget."""
        return self.request.cost(len(self.samples))

    @property
    def room(self) -> int:
        """Real steps that the budget has left, after those that unanswered queries may take."""
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
        """Return a new random generator for this round's rollouts; each call returns the same numbers."""
        return generator_for(self.definition, f"rollouts {self.number}")
