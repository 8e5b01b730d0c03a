"""Variant ``pathwise``: each episode of a lane follows one function drawn from the posterior (TS-infinity of PETS)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from surrogym_server.models.abilities import FunctionDraws, UncertainHyperparameters, offers
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise


def function_draws(model: DynamicsModel, functions: int | None = None) -> FunctionDraws:
    """Return the object that draws functions of a model: the model itself, or a fallback if its family draws none.

    If lanes share a number of ``functions``, hyperparameters are drawn too, so that the few functions cover their
    uncertainty.
    """
    if functions is not None and (able := offers(model, UncertainHyperparameters)) is not None:
        return able.uncertain_functions
    return offers(model, FunctionDraws) or ConstantErrors(model)


@dataclass(frozen=True)
class ConstantErrors(FunctionDraws):
    """Functions that have the same distance from the mean everywhere, in deviations. The reward's function is its mean.

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
    """Draw the functions of the lanes that are in the first step of their episode, under the model of that episode.

    A draw is a pure function of model, seed, lane and episode. With a number of ``functions`` the lane counts modulo
    that number, so that lanes share functions. The draw is still kept in the state, because solving for other lanes in
    the same batch could change its last bits.
    """
    fresh = lanes.elapsed == 0
    if not bool(fresh.any()):
        return lanes
    drawing, draws = lanes.take(fresh), function_draws(model, functions)
    keyed = drawing if functions is None else replace(drawing, lane=drawing.lane % functions)
    noise = normal_noise(keyed, Purpose.PATH, 1, draws.path_size)[:, 0]
    drawn = replace(drawing, path=draws.draw(noise))
    return drawn if len(drawn) == len(lanes) else lanes.put(fresh, drawn)
