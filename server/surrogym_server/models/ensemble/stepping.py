"""Prediction of steps in blocks of rows, for models that are ensembles and whose sampled functions are its members."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property, partial
from typing import ClassVar

import torch
from torch import Tensor

from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.environment.step_rules import moved, placed
from surrogym_server.models.abilities import FunctionDraws
from surrogym_server.models.ensemble.inputs import Inputs
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.tensors import in_blocks


class SteppedInBlocks(DynamicsModel, FunctionDraws):
    """Base class of models that predict many steps in blocks of at most ``rows`` steps, to bound memory."""

    rows: ClassVar[int]

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
        return self._in_blocks(q, u, noise, process, None, stds, reward_std)

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
        return self._in_blocks(q, u, None, process, paths, stds, reward_std)

    @abstractmethod
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

    def _in_blocks(
        self,
        q: Tensor,
        u: Tensor,
        noise: Tensor | None,
        process: Tensor | None,
        paths: Tensor | None,
        stds: bool,
        reward_std: bool,
    ) -> Transition:
        step = partial(self._step, stds, reward_std)
        q_next, reward, spread, doubt = in_blocks(self.rows, step, q, u, noise, process, paths)
        return Transition(q_next, reward, spread if stds else None, doubt if reward_std else None)

    def _arrived(self, q: Tensor, u: Tensor, change: Tensor) -> Tensor:
        return moved(self.definition, self._inverse, q, u, placed(self.definition, change))

    @cached_property
    def _inverse(self) -> ObservationInverse | None:
        return ObservationInverse.of(self.definition) if self.definition.moves_observation else None

    @cached_property
    def _inputs(self) -> Inputs:
        return Inputs(self.definition)


def drawn_member(noise: Tensor, members: int) -> Tensor:
    """Return random indices of networks, from 0 to ``members`` - 1 with equal probability, as floats. Each is computed
    from the standard normal number at the same place of ``noise``."""
    numbers: Tensor = (members * torch.special.ndtr(noise)).floor().clamp_max(members - 1)
    return numbers


def between(values: Tensor, correction: int = 1) -> Tensor:
    """Return the variance of values (K, ...) over the K networks (members). Unlike ``torch.var`` it gives no warning
    for an empty tensor. ``correction`` is the same as in ``torch.var``: 1 divides by K - 1, 0 by K."""
    return values.var(0, correction=correction) if values.numel() else values[0]
