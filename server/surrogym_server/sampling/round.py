"""One round of the design: the data from which rules choose the real steps to request (queries)."""

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
    """Everything from which rules choose the real steps that one round of the design requests (queries): the model with
    O outputs, its judgement, the samples and the request."""

    number: int
    model: DynamicsModel
    samples: Samples
    request: Request
    judgement: Judgement
    tolerances: tuple[float, ...]  # (O,) declared or default tolerances, not widened by noise
    outputs: list[int]  # indices of the outputs that queries should improve, the least confident first; at least one
    # True if the design continues, so that the round may use the rest of the budget. If false, the round may only
    # request ``request.extra`` steps.
    continues: bool
    # True if the model satisfies the stopping rule, but an action sequence away from the samples still has to test it.
    testing: bool

    @property
    def definition(self) -> EnvironmentDefinition:
        return self.model.definition

    @property
    def cost(self) -> int:
        """Number of real steps so far that count towards the budget."""
        return self.request.cost(len(self.samples))

    @property
    def room(self) -> int:
        """Number of real steps that the budget still allows, after those that are reserved for pending queries."""
        return max(0, self.request.budget - self.cost - self.request.pending_steps)

    @property
    def may_examine(self) -> bool:
        """Whether rules may spend real steps on finding the causes of large errors, such as noise or hidden state.

        They may if the design continues, at least half of the budget is spent, and at least half as many adaptive steps
        as initial ones were taken. With a stopping rule other than ``tested_confidence``, as in preset ``paper``, they
        never may.
        """
        design = self.definition.design
        enough = self.cost >= max(self.request.budget / 2, 1.5 * design.initial)
        return self.continues and design.stopping == "tested_confidence" and enough

    def generator(self) -> np.random.Generator:
        """Return a new random generator for this round's rollouts. All generators that it returns in one round give the
        same numbers."""
        return generator_for(self.definition, f"rollouts {self.number}")
