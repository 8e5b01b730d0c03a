"""Prediction of steps with all processes of one model: outputs in groups, and next states from predicted changes.

Usually the outputs are changes of coordinates: q' = q + f(q, u), with angles wrapped and coordinates clipped at their
bounds (eq. 1 with zero mean). If the outputs are changes of the observation instead, o' = o + f(o, u), the coordinates
are computed from the observation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import Encoder, leading
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.environment.step_rules import clip, moved
from surrogym_server.gp import Output
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.gaussian_process.prediction.lookahead import process_inputs
from surrogym_server.models.gaussian_process.prediction.output_group import Grown, OutputGroup
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.regions import Jump, jumped
from surrogym_server.models.port import Transition
from surrogym_server.tensors import cached, in_blocks


@dataclass(frozen=True)
class Predictor:
    """Predictor of the steps (next coordinates and rewards) of one environment from the models of its outputs."""

    definition: EnvironmentDefinition
    transitions: tuple[OutputModel, ...]  # the M transition outputs, in the order of definition.outputs
    reward: OutputModel
    jumps: tuple[Jump, ...]  # regions of states with the constants that are added to the reward inside them
    # Predictor of the prior model. Its predictions are added to the outputs that have learned the difference from it
    # (those with a ``size_with_prior``).
    prior: Predictor | None = None

    def transition(
        self,
        q: Tensor,
        u: Tensor,
        noise: Tensor | None,
        process: Tensor | None,
        paths: Tensor | None,
        stds: bool,
        reward_std: bool,
    ) -> Transition:
        """Predict as ``DynamicsModel.transition`` does, in blocks of rows. Standard deviations are computed only where
        they are requested.

        ``paths`` (m, W) are the weights of the sampled function that each row follows, or None for the mean.
        """
        doubt: Tensor | None = None
        if self.prior is not None and (stds or reward_std or noise is not None or paths is not None):
            doubt = self._doubt(self.prior, q, u)
            noise = None if noise is None else noise * doubt[:, :-1]
            # a sampled function's distance from the mean is proportional to its weights
            paths = None if paths is None else paths[:, : self.path_size] * doubt[:, self.output_of_weight]
        columns = self._columns if stds or noise is not None else ()
        columns += (self._reward_column,) if reward_std else ()
        rows = min(group.serving.rows for group in self._groups if group)
        q_next, mean, spread = in_blocks(rows, partial(self._step, columns), q, u, noise, process, paths)
        reward, edges = self._rewards(q, u, q_next, mean[:, -1])
        std = spread[:, self._places] if stds else None
        of_reward = self._reward_spread(mean[:, -1], spread[:, -1], edges) if reward_std else None
        if doubt is not None:
            std = None if std is None else std * doubt[:, :-1]
            of_reward = None if of_reward is None else of_reward * doubt[:, -1]
        return Transition(q_next, reward, std, of_reward)

    def _doubt(self, prior: Predictor, q: Tensor, u: Tensor) -> Tensor:
        """Return by how much the standard deviations of the outputs (m, O) are larger because the prior model is not
        certain either: sqrt(1 + sigma_p^2 / a^2), sigma_p its standard deviation and a^2 the variance of the output's
        function there before any sample.

        The process of an output has learned the difference from the prior's mean at the samples, so what the prior
        gets wrong is part of it, with an amplitude that grows with sigma_p. So samples narrow it as they do the rest.
        """
        known = prior.transition(q, u, None, None, None, stds=True, reward_std=True)
        assert known.std is not None
        assert known.reward_std is not None
        sigma = torch.cat([known.std, known.reward_std[:, None]], -1)
        return (1 + (sigma / self.growth(q, u)).square() / self.doubted).sqrt()

    def growth(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the amplitude (m, O) of each output that is added to the prior model's prediction, at q (m, C) and u
        (m, F): 1 without rates. For an output that reads next values, present ones stand for them."""
        grown = torch.ones(len(q), len(self.transitions) + 1, dtype=torch.float64, device=self.definition.device)
        for column, output in enumerate((*self.transitions, self.reward)):
            if output.feature_map.rates and output.size_with_prior is not None:
                x = process_inputs(self.definition, output, PredictedSteps(q, u, q))
                grown[:, column] = output.amplitude(x)
        return grown

    @cached
    def doubted(self) -> Tensor:
        """For each output (O,), the variance of its function before any sample where its amplitude is 1; infinite if it
        does not use a prior."""
        outputs = (*self.transitions, self.reward)
        variances = [math.inf if output.size_with_prior is None else output.function_variance for output in outputs]
        return torch.tensor(variances, dtype=torch.float64, device=self.definition.device)

    def means(self, q: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean changes (m, M), next coordinates (m, C) and mean rewards (m,) at q (m, C) and u (m, F)."""
        q_next, mean, _ = self._step((), q, u, None, None, None)
        reward, _ = self._rewards(q, u, q_next, mean[:, -1])
        return mean[:, self._places], q_next, reward

    @cached
    def output_of_weight(self) -> Tensor:
        """Index of the output (W,) to which each weight of a sampled function belongs."""
        places = {column: place for place, column in enumerate((*self._columns, self._reward_column))}
        drawn = [one for group in self._groups if group for one in group.drawn]
        owners = [places[one.column] for one in drawn for _ in range(one.pathwise.size)]
        return torch.tensor(owners, dtype=torch.long, device=self.definition.device)

    @cached_property
    def path_size(self) -> int:
        """Number W of weights of a sampled function."""
        return sum(one.pathwise.size for group in self._groups if group for one in group.drawn)

    def draw(self, noise: Tensor) -> Tensor:
        """Return the weights (N, W) of N functions sampled from the posteriors of all outputs, each computed from one
        row of standard normal numbers ``noise`` (N, W)."""
        samplers = [one for group in self._groups if group for one in group.drawn]
        return torch.cat([noise[:, :0], *(one.pathwise.draw(noise[:, one.span]) for one in samplers)], 1)

    def _step(
        self,
        columns: tuple[int, ...],
        q: Tensor,
        u: Tensor,
        noise: Tensor | None,
        process: Tensor | None,
        paths: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return next coordinates (m, C), predicted values (m, columns), and standard deviations (m, columns), which
        are computed for ``columns`` only; they are (m, 0) if ``columns`` is empty. There is a column for each
        coordinate or observation entry (its change), and one for the reward.

        Outputs are predicted in up to three stages, because some read the predictions of others. The result of a stage
        is 0 in the columns of other stages, so that the results can be added.
        """
        first, second, after = self._groups
        kick, shake = self._in_columns(noise), self._in_columns(process)
        x = first.encoder(q, u)
        mean, spread = first.predict(x, columns, kick, shake, paths)
        if self.prior is not None:
            mean = mean + self._by_prior(self.prior, q, u)
        if second is not None:
            lead = clip(self.definition, q + mean[:, :-1])[:, self._leading]
            following = second.predict(first.encoder.with_lead(x, lead), columns, kick, shake, paths)
            mean, spread = _sum((mean, spread), following)
        q_next = moved(self.definition, self._inverse, q, u, mean[:, :-1])
        if after is not None:
            reward = after.predict(after.encoder(q_next, u), columns, None, None, paths)
            mean, spread = _sum((mean, spread), reward)
        return q_next, mean, spread

    def _by_prior(self, prior: Predictor, q: Tensor, u: Tensor) -> Tensor:
        """Return the prior model's predictions (m, columns) at q (m, C) and u (m, F): a column for each coordinate or
        observation entry, and one for the reward. Columns of outputs that don't use the prior model are 0."""
        change, _, reward = prior.means(q, u)
        added = change.new_zeros(len(q), self._reward_column + 1)
        added[:, self._places], added[:, -1] = change, reward
        return added * self.uses_prior

    @cached
    def uses_prior(self) -> Tensor:
        """Mask of the columns to which the prior model's predictions are added, (columns,), with a column for each
        coordinate or observation entry, and one for the reward: 1 if they are added, otherwise 0."""
        uses = torch.zeros(self._reward_column + 1, dtype=torch.float64, device=self.definition.device)
        outputs = (*self.transitions, self.reward)
        for column, output in zip((*self._columns, self._reward_column), outputs, strict=True):
            uses[column] = output.size_with_prior is not None
        return uses

    def _rewards(self, q: Tensor, u: Tensor, q_next: Tensor, mean: Tensor) -> tuple[Tensor, Tensor | float]:
        """Return the rewards (m,) of steps from q (m, C) under u (m, F) to q_next (m, C), and their variance (m,) due
        to jumps of the reward whose edges are uncertain.

        ``mean`` (m,) is the prediction of the reward's process. Jumps and a declared reward are added to it.
        """
        state = q_next if self.reward.feature_map.after else q
        if self.reward.warp is not None:
            mean = self.reward.warp.value(mean)
        if (declared := self.definition.declared_reward) is not None:
            mean = mean + declared(state, u)
        if not self.jumps:
            return mean, 0.0
        added, variance = jumped(self.jumps, state)
        return mean + added, variance

    def _reward_spread(self, mean: Tensor, spread: Tensor, edges: Tensor | float) -> Tensor:
        """Return the standard deviation of the reward, (m,). ``mean`` and ``spread`` (m,) are mean and standard
        deviation of the reward's process; ``edges`` is the variance due to jumps of the reward whose edges are
        uncertain."""
        if self.reward.warp is not None:
            spread = self.reward.warp.std(mean, spread)
        return (spread.square() + edges).sqrt()

    def _in_columns(self, noise: Tensor | None) -> Tensor | None:
        if noise is None:
            return None
        placed = noise.new_zeros(len(noise), self._reward_column + 1)
        placed[:, self._places] = noise
        return placed

    @cached_property
    def _columns(self) -> tuple[int, ...]:
        """Column of each transition output in predictions: the index of its coordinate, or of its observation entry."""
        return tuple(range(len(self.transitions))) if self.definition.moves_observation else self.definition.moving

    @cached
    def _places(self) -> Tensor:
        """``_columns`` as a tensor on the device: the program would wait for the copy of a list of indices."""
        return torch.tensor(self._columns, dtype=torch.long, device=self.definition.device)

    @cached
    def _leading(self) -> Tensor:
        """Indices of the leading coordinates, as a tensor on the device."""
        return torch.tensor(leading(self.definition), dtype=torch.long, device=self.definition.device)

    @cached_property
    def _reward_column(self) -> int:
        names = self.transitions if self.definition.moves_observation else self.definition.coordinates
        return len(names)

    @cached
    def _groups(self) -> tuple[OutputGroup, OutputGroup | None, OutputGroup | None]:
        """Three groups of outputs: those that read only coordinates and action, those that also read the next values of
        leading coordinates, and the reward if it reads the next state. An empty second or third group is None."""
        after = self.reward.feature_map.after
        outputs = list(zip(self._columns, self.transitions, strict=True))
        reward = [(self._reward_column, self.reward)]
        outputs += [] if after else reward
        leads = [o for o in outputs if o[1].feature_map.lead]
        encoder = Encoder.of(self.definition, [o.feature_map for _, o in outputs])
        first = self._group(encoder, [o for o in outputs if not o[1].feature_map.lead], 0)
        second = self._group(encoder, leads, first.end) if leads else None
        third = None
        if after:
            third = self._group(Encoder.of(self.definition, [self.reward.feature_map]), reward, (second or first).end)
        return first, second, third

    def _group(self, encoder: Encoder, outputs: Sequence[tuple[int, OutputModel]], begin: int) -> OutputGroup:
        processes = [Output(c, o.posterior, encoder.inputs(o.feature_map), o.centre, o.scale) for c, o in outputs]
        lead = any(o.feature_map.lead for _, o in outputs)
        like = torch.zeros(0, dtype=torch.float64, device=self.definition.device)
        growths = tuple(
            Grown(
                column,
                torch.tensor(encoder.inputs(output.feature_map), device=like.device),
                like.new_tensor(output.feature_map.rates),
                output.centre,
            )
            for column, output in outputs
            if output.feature_map.rates
        )
        return OutputGroup.of(encoder, processes, self._reward_column + 1, lead=lead, begin=begin, grown=growths)

    @cached_property
    def _inverse(self) -> ObservationInverse | None:
        return ObservationInverse.of(self.definition) if self.definition.moves_observation else None


def _sum(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return one[0] + other[0], one[1] + other[1]
