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
    default_tolerances: tuple[float, ...]  # (O,) where the specification has none
    continues: bool  # the round may spend what the budget has left; otherwise it may take ``request.extra`` steps
    testing: bool  # the model is sure, and an excursion is to test it

    @property
    def definition(self) -> EnvironmentDefinition:
        return self.model.definition

    @property
    def cost(self) -> int:
        """Real steps that count towards the budget."""
        return len(self.samples) - self.request.free

    @property
    def room(self) -> int:
        """Real steps that the budget has left beside those of the unanswered queries."""
        return max(0, self.request.budget - self.cost - self.request.pending_steps)

    @property
    def may_examine(self) -> bool:
        """Whether the causes of large errors may be examined: in the second half of a budget, once half as many
        adaptive queries as initial ones are answered. The preset of the paper examines nothing."""
        design = self.definition.design
        enough = self.cost >= max(self.request.budget / 2, 1.5 * design.initial)
        return self.continues and design.stopping == "tested_confidence" and enough

    @property
    def below_target(self) -> list[int]:
        """Outputs below their target, the least confident first. If there is none, the least confident output."""
        index = [confidence.confidence_index for confidence in self.judgement.confidences]
        order = sorted(range(len(index)), key=index.__getitem__)
        return [i for i in order if index[i] < self.request.target] or order[:1]

    def generator(self) -> np.random.Generator:
        """Return the random numbers of this round's rollouts, from their beginning."""
        return generator_for(self.definition, f"rollouts {self.number}")
