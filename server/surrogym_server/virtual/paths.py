"""Variant ``pathwise``: each episode of a lane follows one function drawn from what the model believes (TS-infinity of
PETS)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from surrogym_server.models.abilities import FunctionDraws, UncertainHyperparameters, offers
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise


def function_draws(model: DynamicsModel, functions: int | None = None) -> FunctionDraws:
    """What draws functions of a model: itself, or the fallback for a family that draws none.

    Where lanes share a number of ``functions`` these stand for all that the samples allow, so that hyperparameters
    count as uncertain.
    """
    if functions is not None and (able := offers(model, UncertainHyperparameters)) is not None:
        return able.uncertain_functions
    return offers(model, FunctionDraws) or ConstantErrors(model)


@dataclass(frozen=True)
class ConstantErrors(FunctionDraws):
    """Functions that lie the same number of deviations from the mean everywhere; the reward's is its mean.

    A draw is one standard normal number for each transition output.
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
        deviations: bool = False,
        reward_deviation: bool = False,
    ) -> Transition:
        return self.model.transition(
            q,
            u,
            noise=paths[:, : self.path_size],
            process=process,
            deviations=deviations,
            reward_deviation=reward_deviation,
        )


def with_paths(model: DynamicsModel, lanes: LaneState, functions: int | None = None) -> LaneState:
    """Lanes whose functions are drawn: those in the first step of their episode draw it now, under its model.

    A draw is a pure function of model, seed, lane and episode; with a number of ``functions`` the lane counts modulo
    that, so that lanes share functions. It is kept in the state all the same: solving for other
    lanes beside it could change its last bits.
    """
    fresh = lanes.elapsed == 0
    if not bool(fresh.any()):
        return lanes
    drawing, draws = lanes.take(fresh), function_draws(model, functions)
    keyed = drawing if functions is None else replace(drawing, lane=drawing.lane % functions)
    noise = normal_noise(keyed, Purpose.PATH, 1, draws.path_size)[:, 0]
    drawn = replace(drawing, path=draws.draw(noise))
    return drawn if len(drawn) == len(lanes) else lanes.put(fresh, drawn)
