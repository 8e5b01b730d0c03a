"""BayesianLastLayerModel: networks with Bayesian last layers, fitted to one environment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import saturated
from surrogym_server.environment.step_rules import paid
from surrogym_server.models.abilities import (
    Differentiable,
    LearnedNoise,
    LeaveOneOut,
    LeaveOneOutErrors,
    Lookahead,
    OutputOutlook,
    PathOutlook,
    PredictedSteps,
)
from surrogym_server.models.bayesian_last_layer.lookahead import LayerAlongPaths, LayerOutlook
from surrogym_server.models.bayesian_last_layer.regression import Regression
from surrogym_server.models.ensemble.stepping import SteppedInBlocks, drawn_member
from surrogym_server.tensors import cached


@dataclass(frozen=True)
class BayesianLastLayerModel(SteppedInBlocks, LeaveOneOut, LearnedNoise, Lookahead, Differentiable):
    """K members, each with a posterior of its last layers' weights. A drawn function is a member and its weights."""

    rows = 2_048

    definition: EnvironmentDefinition
    transitions: Regression  # M outputs
    reward: Regression | None  # None where it is declared
    ending: Regression | float | None  # of labels -1 and 1; the only label if there is one; None if ends are declared
    terminal_reward: float
    samples: int
    digest: str

    @property
    def path_size(self) -> int:
        return 1 + self.transitions.size + (0 if self.reward is None else self.reward.size)

    def draw(self, noise: Tensor) -> Tensor:
        """Draw functions. A function is the number of its member, all as likely, and the weights of its outputs."""
        number = drawn_member(noise[:, 0], self.transitions.members)
        first, last = self._split(noise)
        weights = [self.transitions.drawn(first, number.long())]
        if self.reward is not None:
            weights.append(self.reward.drawn(last, number.long()))
        return torch.cat([number[:, None], *weights], 1)

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        change = self.transitions.means(self._inputs.of_transition(q, u))
        q_next = self._arrived(q, u, change)
        reward = paid(self.terminal_reward, self._rewards(False, q, u, q_next, None)[0], self.terminated(q_next))
        return torch.cat([change, reward[:, None]], -1)

    def learned_termination(self, q: Tensor) -> Tensor:
        """Probability that the regression of labels, with its noise, is positive. If all samples have the same label,
        that label."""
        if not isinstance(self.ending, Regression):
            return q.new_full((len(q),), self.ending or 0.0)
        ending = self.ending
        phi = ending.phi(self._inputs.of_end(q))
        mean, deviation = ending.members_means(phi).mean(0)[:, 0], ending.deviation(phi)[:, 0]
        chance: Tensor = torch.special.ndtr(mean / torch.hypot(deviation, ending.noise_deviation))
        return chance

    @cached
    def scales(self) -> Tensor:
        scales = self._by_output(self.transitions.scale, None if self.reward is None else self.reward.scale)
        return torch.where(scales > 0, scales, 1.0)

    @property
    def structures(self) -> tuple[str, ...]:
        learned = [_structure(self.transitions, column) for column in range(len(self.transitions.scale))]
        if self.reward is None:
            return (*learned, "declared")
        return (*learned, _structure(self.reward, 0, ", squares included"))

    @property
    def description(self) -> dict[str, Any]:
        columns = zip(
            self.definition.outputs, self.structures, self.scales.tolist(), self.noise_deviations, strict=True
        )
        outputs = [{"name": n, "kernel": s, "scale": scale, "noise": noise} for n, s, scale, noise in columns]
        for described, parts in zip(outputs, self._parts, strict=False):
            described["prior_deviations"] = parts
        return {"outputs": outputs, "terminal_reward": self.terminal_reward, "samples": self.samples}

    @property
    def noise_deviations(self) -> tuple[float, ...]:
        reward = None if self.reward is None else self.reward.noise_deviation
        return tuple(self._by_output(self.transitions.noise_deviation, reward).tolist())

    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        """Errors of the last layer, in closed form. Features and variances have seen all samples, so the errors of the
        whole are larger if the features fit too closely."""
        return tuple(_left_out(self._regression(column)) for column in range(len(self.definition.outputs)))

    def outlook(self, candidates: Points, reference: Points, assumed: Points) -> tuple[OutputOutlook | None, ...]:
        everywhere = Points.joined([candidates, reference, assumed])
        steps = PredictedSteps(everywhere.q, everywhere.u, self.transition(everywhere.q, everywhere.u).q_next)
        spans = (len(candidates), len(candidates) + len(reference))
        found: list[OutputOutlook | None] = []
        for column in range(len(self.definition.outputs)):
            regression, index = self._regression(column)
            if regression is None or not float(regression.scale[index]):
                found.append(None)
                continue
            factor = regression.factor(regression.phi(self._inputs_of(column, steps)))[index]
            scale, noise = float(regression.scale[index]), float(regression.noise[:, index].mean())
            found.append(LayerOutlook.of(factor, noise, scale, self._learns(column, steps.q_next), spans))
        return tuple(found)

    def along(self, steps: PredictedSteps, column: int) -> PathOutlook | None:
        regression, index = self._regression(column)
        if regression is None or not float(regression.scale[index]):
            return None
        flat, shape = steps.flat, steps.q.shape[:-1]
        factor = regression.factor(regression.phi(self._inputs_of(column, flat)))[index]
        learns = self._learns(column, flat.q_next).reshape(shape)
        return LayerAlongPaths(float(regression.scale[index]) * factor.reshape(*shape, -1), learns)

    def as_if_answered(self, steps: PredictedSteps) -> BayesianLastLayerModel:
        """Every member is conditioned on its own mean. So its variance shrinks, and the members' disagreement stays."""
        transitions, reward = self.transitions, self.reward
        for column in range(len(transitions.scale)):
            learns = self._learns(column, steps.q_next)
            phi = transitions.phi(self._inputs_of(column, steps)[learns])
            transitions = transitions.as_if_answered(column, phi)
        if reward is not None:
            column = len(transitions.scale)
            learns = self._learns(column, steps.q_next)
            reward = reward.as_if_answered(0, reward.phi(self._inputs_of(column, steps)[learns]))
        return replace(self, transitions=transitions, reward=reward)

    def _step(
        self,
        deviations: bool,
        reward_deviation: bool,
        q: Tensor,
        u: Tensor,
        noise: Tensor | None,
        process: Tensor | None,
        paths: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        phi = self.transitions.phi(self._inputs.of_transition(q, u))
        wanted = deviations or noise is not None
        spread = self.transitions.deviation(phi) if wanted else q.new_zeros(len(q), 0)
        if paths is None:
            change = self.transitions.members_means(phi).mean(0)
        else:
            change = self.transitions.along(phi, paths[:, 0].long(), self._split(paths)[0])
        change = change if noise is None else change + spread * noise
        change = change if process is None else change + self.transitions.noise_deviation * process
        q_next = self._arrived(q, u, change)
        reward, doubt = self._rewards(reward_deviation, q, u, q_next, paths)
        return q_next, reward, spread, doubt

    def _rewards(
        self, deviation: bool, q: Tensor, u: Tensor, q_next: Tensor, paths: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Rewards (m,) of steps to q_next (m, C), and their deviations (m,), 0 if not requested."""
        if (known := self.definition.declared_reward) is not None:
            return known(q_next if known.after else q, u), q.new_zeros(len(q))
        assert self.reward is not None
        phi = self.reward.phi(self._inputs.of_reward(q, u, q_next))
        spread = self.reward.deviation(phi)[:, 0] if deviation else q.new_zeros(len(q))
        if paths is None:
            return self.reward.members_means(phi).mean(0)[:, 0], spread
        return self.reward.along(phi, paths[:, 0].long(), self._split(paths)[1])[:, 0], spread

    def _split(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """The columns of transitions and reward, of functions or of numbers that draw them (m, W)."""
        end = 1 + self.transitions.size
        return paths[:, 1:end], paths[:, end : self.path_size]

    def _by_output(self, transitions: Tensor, reward: Tensor | None) -> Tensor:
        return torch.cat([transitions, transitions.new_zeros(1) if reward is None else reward])

    def _regression(self, column: int) -> tuple[Regression | None, int]:
        """The regression of an output, None if it is declared, and the output's place in it."""
        count = len(self.transitions.scale)
        return (self.transitions, column) if column < count else (self.reward, 0)

    def _inputs_of(self, column: int, steps: PredictedSteps) -> Tensor:
        if column < len(self.transitions.scale):
            return self._inputs.of_transition(steps.q, steps.u)
        return self._inputs.of_reward(steps.q, steps.u, steps.q_next)

    def _learns(self, column: int, q_next: Tensor) -> Tensor:
        """Which samples that end at q_next (m, C) an output would learn from, (m,) bool."""
        if column == len(self.transitions.scale):
            return ~self.terminated(q_next)
        return ~saturated(self.definition, q_next)

    @property
    def _parts(self) -> list[dict[str, float]]:
        """Prior deviation of each part of the features, in scales, by learned output."""
        learned = [self.transitions, *([] if self.reward is None else [self.reward])]
        rows = [row for regression in learned for row in regression.parts.mean(0).sqrt().tolist()]
        return [dict(zip(("polynomial", "units", "waves"), row, strict=True)) for row in rows]


def _structure(regression: Regression, column: int, more: str = "") -> str:
    if not float(regression.scale[column]):
        return "constant"
    features = regression.features
    networks = "1 network" if regression.members == 1 else f"{regression.members} networks"
    return (
        f"Bayesian last layer of {networks}: 2 x {features.units} units, {features.waves} waves and a linear part{more}"
    )


def _left_out(learned: tuple[Regression | None, int]) -> LeaveOneOutErrors:
    regression, column = learned
    if regression is None or not float(regression.scale[column]):
        return LeaveOneOutErrors(0.0, 1.0, 1.0)
    error, within_one, within_two = regression.left_out[column].tolist()
    return LeaveOneOutErrors(float(regression.scale[column]) * error, within_one, within_two)
