"""Functions sampled from any model: by its ``FunctionDraws``, or by a fallback if its family has no such ability."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surrogym_server.models.abilities import FunctionDraws, UncertainHyperparameters, offers
from surrogym_server.models.port import DynamicsModel, Transition


def function_draws(model: DynamicsModel, functions: int | None = None) -> FunctionDraws:
    """Return the object that samples functions of a model: the model itself, or a fallback if its family samples none.

    Args:
        model: the model.
        functions: number of functions that the lanes share, or None if each episode has its own. With a number,
            hyperparameters are sampled too, so that the few functions cover their uncertainty.
    """
    if functions is not None and (able := offers(model, UncertainHyperparameters)) is not None:
        return able.uncertain_functions
    return offers(model, FunctionDraws) or ConstantErrors(model)


@dataclass(frozen=True)
class ConstantErrors(FunctionDraws):
    """Functions at a constant distance from the mean, in standard deviations of each output; the reward's function is
    its mean.

    Each function is one standard normal number for each transition output.
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
