"""GaussianProcessModel: one fit of one environment, ready to predict. Immutable; complete in itself when stored.

The state moves in coordinates: q' = q + f(q, u), angles wrapped, saturated coordinates clipped (eq. 1 with zero mean).
Where the outputs move the observation instead, o' = o + f(o, u), the coordinates are read back from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import Encoder, leading
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.environment.step_rules import clip, paid, settle
from surrogym_server.gp import Output
from surrogym_server.models.gaussian_process.prediction.description import describe
from surrogym_server.models.gaussian_process.prediction.output_group import OutputGroup
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.regions import Jump, Region, jumped
from surrogym_server.tensors import cached, in_blocks, to_device


@dataclass(frozen=True)
class Transition:
    """Predicted step of m points."""

    q_next: Tensor  # (m, C)
    reward: Tensor  # (m,) mean, without penalty and without what a step that ends the episode pays; see ``paid``
    deviation: Tensor | None  # (m, M) of each transition output, if asked for
    reward_deviation: Tensor | None  # (m,) if asked for


@dataclass(frozen=True)
class GaussianProcessModel:
    """Transition and reward of one environment."""

    definition: EnvironmentDefinition
    transitions: tuple[OutputModel, ...]  # M, in the order of definition.outputs
    reward: OutputModel
    terminal_reward: float  # what a step that ends the episode pays beyond the reward process
    samples: int
    digest: str
    ending: Region | None = None  # where episodes end, if that is learned
    jumps: tuple[Jump, ...] = ()  # of the reward, beyond its process

    def on(self, device: torch.device) -> GaussianProcessModel:
        """The same with its arrays on a device, made once."""
        if device == self.definition.device:
            return self
        if device not in self._elsewhere:
            self._elsewhere[device] = to_device(self, device)
        return self._elsewhere[device]

    @cached_property
    def _elsewhere(self) -> dict[torch.device, GaussianProcessModel]:
        return {}

    @property
    def description(self) -> dict[str, Any]:
        """Structure and hyperparameters of every output, for people."""
        outputs = [describe(o) for o in (*self.transitions, self.reward)]
        if self.definition.declared_reward is not None:
            outputs[-1]["kernel"] = "declared"
        ending = {} if self.ending is None else {"termination": self.ending.description}
        jumps = [{"size": jump.size, **jump.region.description} for jump in self.jumps]
        beyond = {"terminal_reward": self.terminal_reward, "jumps": jumps}
        return {"outputs": outputs, **beyond, "samples": self.samples, **ending}

    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        paths: Tensor | None = None,
        deviations: bool = False,
        reward_deviation: bool = False,
    ) -> Transition:
        """The step from q (m, C) under u (m, F), in blocks of rows; variances only of what is asked for.

        With ``noise`` (m, M), standard normal, each transition output is a draw, mean + deviation * noise, instead of
        its mean. With ``process`` (m, M), standard normal, it is moved by its learned noise as well (w of eq. 2). With
        ``paths`` (m, W), see ``draw``, every output follows a function of its own in each row.
        """
        wanted = self._columns if deviations or noise is not None else ()
        wanted += (self._reward_column,) if reward_deviation else ()
        rows = min(stage.serving.rows for stage in self._groups if stage)
        q_next, mean, spread = in_blocks(rows, partial(self._step, wanted), q, u, noise, process, paths)
        reward, edges = self._rewarded(q, u, q_next, mean[:, -1])
        return Transition(
            q_next,
            reward,
            spread[:, list(self._columns)] if deviations else None,
            (spread[:, -1].square() + edges).sqrt() if reward_deviation else None,
        )

    def draw(self, noise: Tensor) -> Tensor:
        """Functions drawn from the posteriors of all outputs, one a row of standard normal ``noise`` (N, W): (N, W)."""
        drawn = [one for stage in self._groups if stage for one in stage.drawn]
        return torch.cat([noise[:, :0], *(one.pathwise.draw(noise[:, one.span]) for one in drawn)], 1)

    @cached_property
    def path_size(self) -> int:
        """How many numbers a draw is, W."""
        return sum(one.pathwise.size for stage in self._groups if stage for one in stage.drawn)

    @cached
    def scales(self) -> Tensor:
        """Deviation of each output's targets over the samples, (O,), in its own unit."""
        return torch.tensor(
            [o.scale for o in (*self.transitions, self.reward)], dtype=torch.float64, device=self.definition.device
        )

    def terminated(self, q: Tensor) -> Tensor:
        """Whether an episode ends on arriving at q (m, C), (m,)."""
        return self.definition.terminated(q) if self.ending is None else self.ending.probability(q) > 0.5

    def termination_probability(self, q: Tensor) -> Tensor:
        """How likely an episode ends on arriving at q (m, C), (m,): 0 or 1 where termination is declared."""
        return self.definition.terminated(q).to(q.dtype) if self.ending is None else self.ending.probability(q)

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        """Posterior mean of every output, increments and then the reward, at q (m, C) and u (m, F): (m, O)."""
        q_next, mean, _ = self._step((), q, u, None, None, None)
        reward, _ = self._rewarded(q, u, q_next, mean[:, -1])
        reward = paid(self.terminal_reward, reward, self.terminated(q_next))
        return torch.cat([mean[:, list(self._columns)], reward[:, None]], -1)

    def _step(
        self,
        wanted: tuple[int, ...],
        q: Tensor,
        u: Tensor,
        noise: Tensor | None,
        process: Tensor | None,
        paths: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Next coordinates, changes and reward (m, columns), and the deviations of the columns ``wanted``.

        Each stage fills its own columns and leaves the others 0, so that they add up.
        """
        first, second, after = self._groups
        kick, shake = self._in_columns(noise), self._in_columns(process)
        x = first.encoder(q, u)
        mean, spread = first.predict(x, wanted, kick, shake, paths)
        if second is not None:
            lead = clip(self.definition, q + mean[:, :-1])[:, leading(self.definition)]
            following = second.predict(first.encoder.with_lead(x, lead), wanted, kick, shake, paths)
            mean, spread = _sum((mean, spread), following)
        q_next = self._moved(q, mean[:, :-1])
        if after is not None:
            reward = after.predict(after.encoder(q_next, u), wanted, None, None, paths)
            mean, spread = _sum((mean, spread), reward)
        return q_next, mean, spread

    def _rewarded(self, q: Tensor, u: Tensor, q_next: Tensor, mean: Tensor) -> tuple[Tensor, Tensor | float]:
        """Rewards (m,) of steps from q (m, C) under u (m, F) to q_next (m, C), the process' mean and what jumps and a
        declared reward add, and the variance (m,) of where the jumps are, 0 without any."""
        state = q_next if self.reward.feature_map.after else q
        if (known := self.definition.declared_reward) is not None:
            mean = mean + known(state, u)
        if not self.jumps:
            return mean, 0.0
        added, variance = jumped(self.jumps, state)
        return mean + added, variance

    def _moved(self, q: Tensor, change: Tensor) -> Tensor:
        if self.definition.moves_observation:
            return settle(self.definition, self._inverse(self.definition.observe(q) + change, q))
        return settle(self.definition, q + change)

    def _in_columns(self, noise: Tensor | None) -> Tensor | None:
        if noise is None:
            return None
        placed = noise.new_zeros(len(noise), self._reward_column + 1)
        placed[:, list(self._columns)] = noise
        return placed

    @cached_property
    def _columns(self) -> tuple[int, ...]:
        """Where each transition output stands: at its coordinate, or at its observation entry."""
        return tuple(range(len(self.transitions))) if self.definition.moves_observation else self.definition.moving

    @cached_property
    def _reward_column(self) -> int:
        moved = self.transitions if self.definition.moves_observation else self.definition.coordinates
        return len(moved)

    @cached
    def _groups(self) -> tuple[OutputGroup, OutputGroup | None, OutputGroup | None]:
        """What reads (q, u), what reads the lead as well, and a reward that reads the next state."""
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
        served = [Output(c, o.posterior, encoder.inputs(o.feature_map), o.centre, o.scale) for c, o in outputs]
        lead = any(o.feature_map.lead for _, o in outputs)
        return OutputGroup.of(encoder, served, self._reward_column + 1, lead=lead, begin=begin)

    @cached
    def _inverse(self) -> ObservationInverse:
        return ObservationInverse.of(self.definition)


def _sum(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return one[0] + other[0], one[1] + other[1]
