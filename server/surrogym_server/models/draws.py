"""Sampling of functions from any model: by the model's ability ``FunctionDraws``, or by a fallback without it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surrogym_server.models.abilities import FunctionDraws, UncertainHyperparameters, offers
from surrogym_server.models.port import DynamicsModel, Transition


def function_draws(model: DynamicsModel, functions: int | None = None) -> FunctionDraws:
    """Return the object that samples functions of a model: usually the model itself, or ``ConstantErrors`` if the
    model's family can't sample functions.

    Args:
        model: the model.
        functions: number of functions that the lanes (parallel environments) share, or None if each episode samples a
            function. With a number, the object also samples hyperparameters if the model can, so that few functions
            cover the uncertainty of hyperparameters too.
    """
    if functions is not None and (able := offers(model, UncertainHyperparameters)) is not None:
        return able.uncertain_functions
    return offers(model, FunctionDraws) or ConstantErrors(model)


@dataclass(frozen=True)
class ConstantErrors(FunctionDraws):
    """Sampler of functions for any model: in each function, every transition output is its mean plus a constant number
    of its standard deviations. The reward is its mean.

    The weights of a function are these constant numbers, drawn from the standard normal distribution.
    """

    model: DynamicsModel

    @property
    def path_size(self) -> int:
        return len(self.model.definition.outputs) - 1

    def draw(self, noise: Tensor) -> Tensor:
        return noise

    def transition_along(
        self,
        paths: Tensor,
        q: Tensor,
        u: Tensor,
        *,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        return self.model.transition(
            q,
            u,
            noise=paths[:, : self.path_size],
            process=process,
            stds=stds,
            reward_std=reward_std,
        )
