"""A declared reward: a weighted sum of functions, such as the square, of quantities computed from state and action. It
is data, and evaluating it runs no code of a user."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.conditions import Conditions, InequalityDefinition
from surrogym_server.environment.terms import TermDefinition, TermSet, compile_terms
from surrogym_server.tensors import CPU, cached, to_device
from surrogym_shared.kinds import RewardShape


@dataclass(frozen=True)
class QuantityDefinition:
    """Quantity on which terms of a declared reward depend: x = term(q) + action . u, with coordinates q and
    action u."""

    term: TermDefinition
    action: tuple[float, ...]  # (F,) weight of each action entry in the quantity


@dataclass(frozen=True)
class RewardTermDefinition:
    """Term of a declared reward: weight * shape(x_1, x_2, ...), if every inequality in ``when`` holds, else 0. The
    shape is a function, such as the square, of the quantities x_1, x_2, ... in ``of``; see ``spec.RewardTerm``."""

    weight: float
    shape: RewardShape
    of: tuple[QuantityDefinition, ...]
    when: tuple[InequalityDefinition, ...]


@dataclass(frozen=True)
class DeclaredRewardDefinition:
    """Declared reward: the sum of its terms, which depend on the action and on the state before or after the step."""

    terms: tuple[RewardTermDefinition, ...]
    after: bool  # whether the reward depends on the state after the step instead of the one before
    terminal: float  # reward that is added if the step reaches a terminal state
    coordinates: int  # number of coordinates of a state, C
    device: torch.device = CPU  # device on which the reward is computed

    def __call__(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the reward (m,) of actions u (m, F) in states q (m, C), without the reward ``terminal`` of terminating
        steps. If ``after`` is true, q are the states after the step, otherwise those before it."""
        values, weights, conditions = self._compiled
        # ``weights`` is empty if the reward depends on no quantity.
        x = values(q) + u @ weights if weights.numel() else values(q)
        holds = conditions(q)
        total = q.new_zeros(len(q))
        begin = 0
        for index, term in enumerate(self.terms):
            own = x[:, begin : begin + len(term.of)]
            begin += len(term.of)
            total = total + term.weight * _shaped(term.shape, own) * holds[:, index]
        return total

    @cached
    def _compiled(self) -> tuple[TermSet, Tensor, Conditions]:
        """Compiled form of the reward: the functions of the coordinates in its X quantities, the action weights (F, X)
        of these quantities, and the conditions of each reward term."""
        quantities = [quantity for term in self.terms for quantity in term.of]
        weights = torch.tensor([quantity.action for quantity in quantities], dtype=torch.float64)
        terms = compile_terms([quantity.term for quantity in quantities], self.coordinates)
        conditions = Conditions.of([term.when for term in self.terms], self.coordinates)
        compiled = terms, weights.T if quantities else weights.reshape(1, 0), conditions
        return to_device(compiled, self.device)


def _shaped(shape: RewardShape, x: Tensor) -> Tensor:
    match shape:
        case "one":
            return x.new_ones(len(x))
        case "linear":
            return x.sum(-1)
        case "absolute":
            return x.abs().sum(-1)
        case "square":
            return x.square().sum(-1)
        case "bump":
            return torch.exp(-0.5 * x.square().sum(-1))
        case "ball":
            return (x.square().sum(-1) <= 1).to(x.dtype)
