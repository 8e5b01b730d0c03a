"""Prediction of several outputs of a model together, from the same features of state and action."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.features import Encoder
from surrogym_server.gp import Output, Pathwise, Serving
from surrogym_server.tensors import amplitude


@dataclass(frozen=True)
class Drawn:
    """Sampler of functions of one output, and the place of this output's weights among the W weights of a sampled
    function of all outputs."""

    column: int
    span: slice  # columns of this output's weights among the W weights of a sampled function
    pathwise: Pathwise


@dataclass(frozen=True)
class Grown:
    """Output that changes faster the larger its inputs are: its distance from ``centre`` is multiplied by an amplitude
    that grows along its inputs, see ``gp.growth``."""

    column: int
    inputs: Tensor  # indices of the features that the output reads
    rates: Tensor  # for each feature that the output reads, the rate with which the amplitude grows along it
    centre: float


@dataclass(frozen=True)
class OutputGroup:
    """Outputs of a model that read the same features. Predictions have a column for each coordinate or observation
    entry (its change), and one for the reward. Columns without an output of the group are 0."""

    encoder: Encoder
    serving: Serving
    noise_std: Tensor  # (columns,) standard deviation of the learned noise of the output in each column, in its unit
    drawn: tuple[Drawn, ...]  # sampler of functions of each output; outputs that never varied have none
    end: int  # index after this group's last weight among the W weights of a sampled function
    grown: tuple[Grown, ...] = ()

    @classmethod
    def of(
        cls,
        encoder: Encoder,
        outputs: Sequence[Output],
        columns: int,
        *,
        lead: bool,
        begin: int,
        grown: tuple[Grown, ...] = (),
    ) -> OutputGroup:
        """Arrange some outputs of a model for prediction.

        Args:
            encoder: encoder of state and action as the features that the outputs read.
            outputs: the outputs, each with its column.
            columns: number of columns of a prediction.
            lead: whether outputs also read the next values of leading coordinates, see ``features.leading``.
            begin: index of the group's first weight in a sampled function.
            grown: rates of those outputs that have rates, see ``Grown``.
        """
        device = encoder.definition.device
        serving = Serving.of(outputs, columns, encoder.width(lead), device)
        noise, samplers = torch.zeros(columns, dtype=torch.float64, device=device), []
        for column, process in serving.processes.items():
            pathwise = process.pathwise
            noise[column] = process.scale * math.sqrt(pathwise.posterior.hyper.noise_variance)
            samplers.append(Drawn(column, slice(begin, begin := begin + pathwise.size), pathwise))
        return cls(encoder, serving, noise, tuple(samplers), begin, grown)

    def predict(
        self, x: Tensor, columns: tuple[int, ...], kick: Tensor | None, process: Tensor | None, paths: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return predicted values at features x (m, d), and their standard deviations without noise, each with a row
        for each point and all columns of a prediction.

        Args:
            x: features.
            columns: indices of the columns whose standard deviations are needed; without any, the second result is (m,
                0).
            kick: numbers of standard deviations to add to the mean, in all columns, or None.
            process: standard normal numbers, by which the learned noise moves the values, in all columns, or None.
            paths: (m, W) weights of a sampled function for each row, whose value replaces the mean, or None.
        """
        if columns or paths is not None:
            first = self.drawn[0].span.start if self.drawn else 0
            value, spread = self.serving.mean_and_std(x, columns, paths, first)
        else:
            value, spread = self.serving.mean(x), x.new_zeros(len(x), 0)
        if kick is not None:
            value = torch.addcmul(value, spread, kick)
        if process is not None:
            value = torch.addcmul(value, self.noise_std, process)
        for one in self.grown:
            grown = amplitude(x[:, one.inputs], one.rates)
            value[:, one.column] = one.centre + grown * (value[:, one.column] - one.centre)
            if columns:
                spread[:, one.column] *= grown
        return value, spread
