"""Model that consists of a few networks fitted to one environment, whose disagreement is its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.environment.step_rules import moved, paid, placed
from surrogym_server.models.abilities import FunctionDraws, LearnedNoise
from surrogym_server.models.ensemble.inputs import Inputs
from surrogym_server.models.ensemble.networks import Networks, bounded
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.tensors import cached, in_blocks

ROWS = 8_192  # steps are predicted in blocks of at most this number of steps, to bound memory


@dataclass(frozen=True)
class Noise:
    """Learned noise of single steps, which depends on the inputs. Its unit is the standard deviation of each of the p
    outputs over the samples."""

    networks: Networks  # networks that predict the log variance of the noise
    size: Tensor  # (p,) root mean square of the predicted noise of each output over the samples

    def std(self, x: Tensor) -> Tensor:
        """Return the standard deviations (m, p) of the noise of p outputs at inputs x (m, d): the root of the mean
        variance over the networks."""
        return bounded(self.networks(x)).exp().mean(0).sqrt()


@dataclass(frozen=True)
class Regression:
    """Predictor of p outputs by networks f: centre + scale * f(x), in the units of the outputs. An output that never
    varied has scale 0."""

    networks: Networks
    centre: Tensor  # (p,) mean of each output over the samples
    scale: Tensor  # (p,) standard deviation of each output over the samples
    noise: Noise | None = None  # learned noise of transition outputs; None for rewards, whose noise is not learned

    def __call__(self, x: Tensor) -> Tensor:
        """Return the predictions (K, m, p) of p outputs by each of K networks at inputs x (m, d), in the outputs'
        units."""
        return self.centre + self.scale * self.networks(x)

    def shaken(self, x: Tensor, process: Tensor) -> Tensor:
        """Return sampled noise of p outputs at inputs x (m, d), in the outputs' units, (m, p), computed from standard
        normal numbers ``process`` (m, p)."""
        assert self.noise is not None
        return self.scale * self.noise.std(x) * process


@dataclass(frozen=True)
class NetworkEnsembleModel(DynamicsModel, FunctionDraws, LearnedNoise):
    """Model of K networks (members). A prediction has the mean and the standard deviation of the networks' predictions.
    The learned noise of a transition depends on the state; no noise of the reward is learned."""

    definition: EnvironmentDefinition
    transitions: Regression  # networks that predict the M transition outputs (changes of coordinates)
    reward: Regression | None  # networks that predict the reward; None if the specification declares the reward
    # Networks that predict the logit of termination. If all samples have the same label, this label, 0 or 1, instead.
    # None if termination is declared.
    ending: Networks | float | None
    terminal_reward: float
    samples: int
    digest: str

    @property
    def noise_stds(self) -> tuple[float, ...]:
        """Standard deviation of each output's noise, as a root mean square over the samples; 0 for the reward."""
        assert self.transitions.noise is not None
        return (*(self.transitions.scale * self.transitions.noise.size).tolist(), 0.0)

    @property
    def path_size(self) -> int:
        return 1

    def draw(self, noise: Tensor) -> Tensor:
        """Sample N functions from standard normal numbers ``noise`` (N, 1). Each function is one of the networks
        (members), chosen with equal probability; its weight (N, 1) is the index of the network."""
        members = self.transitions.networks.members
        chosen: Tensor = (members * torch.special.ndtr(noise)).floor().clamp_max(members - 1)
        return chosen

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        change = self.transitions(self._inputs.of_transition(q, u)).mean(0)
        q_next = self._arrived(q, u, change)
        reward = paid(self.terminal_reward, self._rewards(q, u, q_next).mean(0), self.terminated(q_next))
        return torch.cat([change, reward[:, None]], -1)

    def learned_termination(self, q: Tensor) -> Tensor:
        """Return the probability (m,) of termination at q (m, C), as a mean over the networks. If all samples have the
        same label, the result is this label, 0 or 1."""
        if isinstance(self.ending, Networks):
            return self.ending(self._inputs.of_end(q))[..., 0].sigmoid().mean(0)
        return q.new_full((len(q),), self.ending or 0.0)

    @cached
    def scales(self) -> Tensor:
        reward = self.transitions.scale.new_zeros(1) if self.reward is None else self.reward.scale
        scales = torch.cat([self.transitions.scale, reward])
        return torch.where(scales > 0, scales, 1.0)

    @property
    def structures(self) -> tuple[str, ...]:
        members, units = self.transitions.networks.members, self.transitions.networks.second.shape[-1]
        network = f"{members} networks, 2 x {units} units and a linear part"
        learned = [network if float(scale) else "constant" for scale in self.transitions.scale]
        if self.reward is None:
            return (*learned, "declared")
        return (*learned, f"{network}, squares included" if float(self.reward.scale) else "constant")

    @property
    def description(self) -> dict[str, Any]:
        names, scales = self.definition.outputs, self.scales.tolist()
        outputs = [
            {"name": name, "kernel": structure, "scale": scale, "noise": noise}
            for name, structure, scale, noise in zip(names, self.structures, scales, self.noise_stds, strict=True)
        ]
        return {"outputs": outputs, "terminal_reward": self.terminal_reward, "samples": self.samples}

    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        q_next, reward, spread, doubt = in_blocks(
            ROWS, partial(self._step, stds, reward_std), q, u, noise, process, None
        )
        return Transition(q_next, reward, spread if stds else None, doubt if reward_std else None)

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
        q_next, reward, spread, doubt = in_blocks(
            ROWS, partial(self._step, stds, reward_std), q, u, None, process, paths
        )
        return Transition(q_next, reward, spread if stds else None, doubt if reward_std else None)

    def _step(
        self,
        stds: bool,
        reward_std: bool,
        q: Tensor,
        u: Tensor,
        noise: Tensor | None,
        process: Tensor | None,
        paths: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Predict one block of m steps.

        Args:
            stds, reward_std: whether standard deviations of transition outputs and of the reward are needed.
            q: coordinates (m, C).
            u: actions (m, F).
            noise: number of standard deviations that are added to the mean of each transition output, (m, M), or None.
            process: standard normal numbers, (m, M), by which the learned noise moves each transition output, or None.
            paths: weights of the sampled function that each row follows, (m, W), or None for the mean.

        Returns:
            Next coordinates (m, C), rewards (m,), standard deviations of transition outputs (m, M), and standard
            deviations of the reward (m,). Standard deviations that are not needed are (m, 0).
        """
        member = None if paths is None else paths[:, 0].long()
        x = self._inputs.of_transition(q, u)
        changes = self.transitions(x)
        spread = between(changes).sqrt() if stds or noise is not None else q.new_zeros(len(q), 0)
        change = _of_member(changes, member)
        change = change if noise is None else change + spread * noise
        change = change if process is None else change + self.transitions.shaken(x, process)
        q_next = self._arrived(q, u, change)
        rewards = self._rewards(q, u, q_next)
        doubt = between(rewards).sqrt() if reward_std else q.new_zeros(len(q), 0)
        return q_next, _of_member(rewards, member), spread, doubt

    def _arrived(self, q: Tensor, u: Tensor, change: Tensor) -> Tensor:
        return moved(self.definition, self._inverse, q, u, placed(self.definition, change))

    @cached_property
    def _inverse(self) -> ObservationInverse | None:
        return ObservationInverse.of(self.definition) if self.definition.moves_observation else None

    @cached_property
    def _inputs(self) -> Inputs:
        return Inputs(self.definition)

    def _rewards(self, q: Tensor, u: Tensor, q_next: Tensor) -> Tensor:
        """Return the rewards (K, m) that each of the K networks predicts for m steps from q (m, C) under u (m, F) to
        q_next (m, C)."""
        if (declared := self.definition.declared_reward) is not None:
            return declared(q_next if declared.after else q, u).expand(self.transitions.networks.members, -1)
        assert self.reward is not None
        return self.reward(self._inputs.of_reward(q, u, q_next))[..., 0]


def between(values: Tensor) -> Tensor:
    """Return the variance of values (K, ...) over the K networks (members). Unlike ``torch.var`` it gives no warning
    for an empty tensor."""
    return values.var(0) if values.numel() else values[0]


def _of_member(values: Tensor, member: Tensor | None) -> Tensor:
    """Return the mean of the values (K, m, ...) over the K networks (members). If ``member`` (m,) is given, return
    instead the value of network ``member[i]`` in each row i."""
    if member is None:
        return values.mean(0)
    return values[member, torch.arange(len(member), device=member.device)]
