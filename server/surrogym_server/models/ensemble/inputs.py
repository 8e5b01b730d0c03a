"""Encoding of states and actions as inputs of networks: features with mean near 0 and standard deviation near 1."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import Encoder, Encoding, FeatureMap, State
from surrogym_server.tensors import cached


@dataclass(frozen=True)
class Inputs:
    """Encodings of the states and actions of one environment as inputs of networks."""

    definition: EnvironmentDefinition

    def of_transition(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the inputs (m, d) of the transition networks at coordinates q (m, C) and actions u (m, F)."""
        return self._of_transition(q, u)

    def of_reward(self, q: Tensor, u: Tensor, q_next: Tensor) -> Tensor:
        """Return the inputs (m, d) of the reward networks: of the state before the step, after it, or both, as the
        definition's ``reward_timing`` says."""
        match self.definition.reward_timing:
            case "before":
                return self._of_state(q, u)
            case "after":
                return self._of_state(q_next, u)
            case "auto":
                return torch.cat([self._of_state(q, u), self._of_state(q_next, u)], -1)

    def of_end(self, q: Tensor) -> Tensor:
        """Return the inputs (m, d) of the termination networks at the next coordinates q (m, C)."""
        return self._of_state(q, q.new_zeros(len(q), self.definition.action.size))

    @cached
    def _of_transition(self) -> Encoder:
        return self._encoder("observation" if self.definition.moves_observation else "cos_sin")

    @cached
    def _of_state(self) -> Encoder:
        """Encoder of the coordinates, and also of the observation if its entries combine coordinates."""
        combined = self.definition.observation_combines or self.definition.moves_observation
        more: tuple[State, ...] = ("observation",) if combined else ()
        return self._encoder("both", *more)

    def _encoder(self, *states: State) -> Encoder:
        action: Encoding = "one_hot" if self.definition.action.nvec else "value"
        return Encoder.of(self.definition, [FeatureMap(state, action) for state in states])
