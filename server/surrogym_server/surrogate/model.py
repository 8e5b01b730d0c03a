"""SurrogateModel: one fit of one environment, ready to predict. Immutable; complete in itself when stored.

The state moves in coordinates: q' = q + f(q, u), angles wrapped, saturated coordinates clipped (eq. 1 with zero mean).
Preset ``paper`` moves the observation instead, o' = o + f(o, u), and reads the coordinates back from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from surrogym_server.gp import Posterior
from surrogym_server.surrogate.definition import EnvironmentDefinition, wrap
from surrogym_server.surrogate.features import FeatureMap, encode, leading
from surrogym_server.surrogate.recover import ObservationInverse


@dataclass(frozen=True)
class OutputModel:
    """The process of one output, and the scaling of its targets: y = (target - centre) / scale.

    ``posterior`` is None for an output that never varied: its mean is ``centre`` and its deviation 0.
    """

    name: str
    feature_map: FeatureMap
    posterior: Posterior | None
    centre: float
    scale: float
    left_out: int = 0  # samples left out because they ended at a bound
    scores: tuple[tuple[str, float], ...] = ()  # evidence of every feature map compared

    def mean(self, x: Tensor) -> Tensor:
        """Posterior mean at features x (m, d), in the output's unit, (m,)."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre)
        return self.centre + self.scale * self.posterior.mean(x)

    def mean_and_deviation(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Posterior mean and latent deviation at x (m, d), in the output's unit, (m,) each."""
        if self.posterior is None:
            return x.new_full(x.shape[:-1], self.centre), x.new_zeros(x.shape[:-1])
        mean, variance = self.posterior.mean_and_variance(x)
        return self.centre + self.scale * mean, self.scale * variance.sqrt()


@dataclass(frozen=True)
class Transition:
    """Predicted step of m points: next coordinates (m, C) and, if asked for, the deviation of each output (m, M)."""

    q_next: Tensor
    deviation: Tensor | None


@dataclass(frozen=True)
class SurrogateModel:
    """Transition and reward of one environment."""

    definition: EnvironmentDefinition
    transitions: tuple[OutputModel, ...]  # M, in the order of definition.outputs
    reward: OutputModel
    terminal_reward: float  # what a step that ends the episode pays beyond the reward process
    samples: int
    digest: str

    @property
    def description(self) -> dict[str, Any]:
        """Structure and hyperparameters of every output, for people."""
        outputs = [_describe(o) for o in (*self.transitions, self.reward)]
        return {"outputs": outputs, "terminal_reward": self.terminal_reward, "samples": self.samples}

    def transition(self, q: Tensor, u: Tensor, *, noise: Tensor | None = None, deviations: bool = False) -> Transition:
        """Next coordinates of q (m, C) under u (m, F).

        With ``noise`` (m, M), standard normal, each output is a draw, mean + deviation * noise, instead of its mean.
        """
        if self.definition.design.preset == "paper":
            return self._observation_transition(q, u, noise, deviations)
        return self._coordinate_transition(q, u, noise, deviations)

    def predict_reward(
        self, q: Tensor, u: Tensor, q_next: Tensor, terminated: Tensor, *, deviations: bool = True
    ) -> tuple[Tensor, Tensor | None]:
        """Mean and deviation (m,) of the reward of steps from q (m, C) under u (m, F) to q_next, before any penalty."""
        state = q if self.definition.reward_timing == "before" else q_next
        x = encode(self.definition, self.reward.feature_map, state, u)
        bonus = self.terminal_reward * terminated
        if not deviations:
            return self.reward.mean(x) + bonus, None
        mean, deviation = self.reward.mean_and_deviation(x)
        return mean + bonus, deviation

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        """Posterior mean of every output, increments and then the reward, at q (m, C) and u (m, F): (m, O)."""
        q_next = self.transition(q, u).q_next
        lead = q_next[..., leading(self.definition)]
        changes = [o.mean(encode(self.definition, o.feature_map, q, u, lead)) for o in self.transitions]
        reward, _ = self.predict_reward(q, u, q_next, self.definition.terminated(q_next), deviations=False)
        return torch.stack([*changes, reward], -1)

    def _coordinate_transition(self, q: Tensor, u: Tensor, noise: Tensor | None, deviations: bool) -> Transition:
        definition, q_next = self.definition, q.clone()
        drawn: list[Tensor | None] = [None] * len(self.transitions)
        encoded: dict[FeatureMap, Tensor] = {}
        lead: Tensor | None = None
        for column in self._order:
            output, index = self.transitions[column], definition.moving[column]
            if output.feature_map.lead and lead is None:
                lead = clip(definition, q_next)[..., leading(definition)]
            if output.feature_map not in encoded:
                encoded[output.feature_map] = encode(definition, output.feature_map, q, u, lead)
            change, drawn[column] = _change(output, encoded[output.feature_map], noise, column, deviations)
            q_next[..., index] += change
        q_next = settle(definition, q_next)
        return Transition(q_next, torch.stack([d for d in drawn if d is not None], -1) if deviations else None)

    @cached_property
    def _order(self) -> tuple[int, ...]:
        """Columns of the moving coordinates, those that read the lead last."""
        return tuple(sorted(range(len(self.transitions)), key=lambda i: self.transitions[i].feature_map.lead))

    def _observation_transition(self, q: Tensor, u: Tensor, noise: Tensor | None, deviations: bool) -> Transition:
        x = encode(self.definition, self.transitions[0].feature_map, q, u)
        changes = [_change(o, x, noise, i, deviations) for i, o in enumerate(self.transitions)]
        o_next = self.definition.observe(q) + torch.stack([c for c, _ in changes], -1)
        q_next = settle(self.definition, self._inverse(o_next, q))
        return Transition(q_next, torch.stack([d for _, d in changes if d is not None], -1) if deviations else None)

    @cached_property
    def _inverse(self) -> ObservationInverse:
        return ObservationInverse.of(self.definition)


def clip(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Coordinates q (..., C) inside their saturation bounds."""
    low, high = definition.bounds
    return torch.clamp(q, low.to(q.device), high.to(q.device))


def settle(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Coordinates as the environment leaves them: clipped, stopped at walls, angles wrapped. q (..., C)."""
    inside = clip(definition, q)
    for index, coordinate in enumerate(definition.coordinates):
        if coordinate.stops is not None:
            speed = inside[..., coordinate.stops]
            into_low = (inside[..., index] <= coordinate.low) & (speed < 0)
            into_high = (inside[..., index] >= coordinate.high) & (speed > 0)
            inside[..., coordinate.stops] = torch.where(into_low | into_high, 0.0, speed)
        if coordinate.kind == "angle":
            inside[..., index] = wrap(inside[..., index])
    return inside


def _change(
    output: OutputModel, x: Tensor, noise: Tensor | None, column: int, deviations: bool
) -> tuple[Tensor, Tensor | None]:
    if noise is None and not deviations:
        return output.mean(x), None
    mean, deviation = output.mean_and_deviation(x)
    if noise is not None:
        mean = mean + deviation * noise[..., column]
    return mean, deviation if deviations else None


def _describe(output: OutputModel) -> dict[str, Any]:
    described: dict[str, Any] = {
        "name": output.name,
        "inputs": str(output.feature_map),
        "kernel": "constant",
        "centre": output.centre,
        "scale": output.scale,
        "left_out": output.left_out,
        "scores": dict(output.scores),
    }
    if output.posterior is not None:
        hyper = output.posterior.hyper
        described |= {
            "kernel": hyper.kernel,
            "points": len(output.posterior.y),
            "lengthscale": hyper.lengthscale.tolist(),
            "signal_variance": hyper.signal_variance,
            "linear_variance": hyper.linear_variance,
            "quadratic_variance": hyper.quadratic_variance,
            "noise_variance": hyper.noise_variance,
            "jitter": output.posterior.jitter,
        }
    return described
