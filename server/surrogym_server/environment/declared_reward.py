"""A declared reward: a weighted sum of functions, such as the square, of quantities computed from state and action. It
is data, and evaluating it runs no code of a user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.conditions import Conditions
from surrogym_server.environment.terms import TermSet, compile_terms
from surrogym_server.tensors import CPU, to_device
from surrogym_shared.kinds import RewardShape
from surrogym_shared.spec import DeclaredReward


@dataclass(frozen=True)
class RewardFunction:
    """Compiled declared reward: a sum of R terms, which depend on X quantities. See ``spec.RewardTerm``."""

    declared: DeclaredReward
    values: TermSet  # part of each of the X quantities that depends on the coordinates
    weights: Tensor  # (F, X) weight of each action entry in each quantity; empty if the reward depends on no quantity
    conditions: Conditions  # one group of inequalities for each of the R terms, which counts only where they all hold

    @classmethod
    def of(
        cls, declared: DeclaredReward, names: Sequence[str], actions: int, device: torch.device = CPU
    ) -> RewardFunction:
        """Compile a reward of the C coordinates ``names`` and of F = ``actions`` action entries."""
        quantities = [quantity for term in declared.terms for quantity in term.of]
        values = compile_terms([quantity.of_state for quantity in quantities], names)
        rows = [quantity.action or (0.0,) * actions for quantity in quantities]
        weights = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), -1 if rows else 1).T
        conditions = Conditions.of([term.when for term in declared.terms], names)
        return to_device(cls(declared, values, weights, conditions), device)

    @property
    def after(self) -> bool:
        """Whether the reward depends on the state after the step instead of the one before."""
        return self.declared.timing == "after"

    @property
    def terminal(self) -> float:
        """Reward that is added if the step reaches a terminal state."""
        return self.declared.terminal

    def __call__(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the reward (m,) of actions u (m, F) in states q (m, C), without the reward ``terminal`` of terminating
        steps. If ``after`` is true, q are the states after the step, otherwise those before it."""
        x = self.values(q) + u @ self.weights if self.weights.numel() else self.values(q)
        holds = self.conditions(q)
        total = q.new_zeros(len(q))
        begin = 0
        for index, term in enumerate(self.declared.terms):
            own = x[:, begin : begin + len(term.of)]
            begin += len(term.of)
            total = total + term.weight * _shaped(term.shape, own) * holds[:, index]
        return total


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
