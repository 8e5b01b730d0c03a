"""Outputs that are predicted together from one set of features."""

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
    span: slice  # where the weights of this output are
    inputs: Tensor  # columns of x that the output reads
    scale: float
    pathwise: Pathwise


@dataclass(frozen=True)
class Grown:
    """Output with rates: its distance from ``centre`` is multiplied by an amplitude that grows along its inputs, see
    ``gp.growth``."""

    column: int
    inputs: Tensor  # columns of x that the output reads
    rates: Tensor  # rate of each of these inputs
    centre: float


@dataclass(frozen=True)
class OutputGroup:
    """Outputs of a model that read the same features. Predictions have a column for each of the model's O outputs;
    columns of outputs outside the group are 0."""

    encoder: Encoder
    serving: Serving
    noise_std: Tensor  # (O,) standard deviation of the learned noise, in each output's unit
    drawn: tuple[Drawn, ...]  # samplers of the outputs' functions; constant outputs have none
    end: int  # end of this group's weights among the W weights of a sampled function
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
        """Compile some outputs of a model for prediction.

        Args:
            encoder: encoder of the features x.
            outputs: the outputs, each with its column.
            columns: number O of columns of a prediction.
            lead: whether the outputs read the next values of leading coordinates.
            begin: index of the group's first weight in a sampled function.
            grown: rates of those outputs that have rates, see ``Grown``.
        """
        device = encoder.definition.device
        noise, samplers = torch.zeros(columns, dtype=torch.float64, device=device), []
        for output in outputs:
            if output.posterior is None:
                continue
            noise[output.column] = output.scale * math.sqrt(output.posterior.hyper.noise_variance)
            pathwise = Pathwise(output.posterior)
            span = slice(begin, begin := begin + pathwise.size)
            samplers.append(
                Drawn(output.column, span, torch.tensor(output.inputs, device=device), output.scale, pathwise)
            )
        serving = Serving.of(outputs, columns, encoder.width(lead), device)
        return cls(encoder, serving, noise, tuple(samplers), begin, grown)

    def predict(
        self, x: Tensor, columns: tuple[int, ...], kick: Tensor | None, process: Tensor | None, paths: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return predicted values at features x (m, d), (m, O), and standard deviations without noise, (m, O).

        Args:
            x: features.
            columns: indices of the outputs whose standard deviations are needed; if there are none, the second result
                is (m, 0).
            kick: (m, O) numbers of standard deviations to add to the mean, or None.
            process: (m, O) standard normal numbers, by which the learned noise moves the values, or None for no noise.
            paths: (m, W) weights of a sampled function for each row, whose value replaces the mean, or None.
        """
        if columns:
            value, spread = self.serving.mean_and_std(x, columns)
        else:
            value, spread = self.serving.mean(x), x.new_zeros(len(x), 0)
        if kick is not None:
            value = torch.addcmul(value, spread, kick)
        if process is not None:
            value = torch.addcmul(value, self.noise_std, process)
        if paths is not None:
            value = value + self._residuals(x, paths)
        for one in self.grown:
            grown = amplitude(x[:, one.inputs], one.rates)
            value[:, one.column] = one.centre + grown * (value[:, one.column] - one.centre)
            if columns:
                spread[:, one.column] *= grown
        return value, spread

    def _residuals(self, x: Tensor, paths: Tensor) -> Tensor:
        residuals = x.new_zeros(len(x), len(self.noise_std))
        for one in self.drawn:
            residual = one.pathwise.residual(x[:, one.inputs], paths[:, one.span])
            residuals[:, one.column] = one.scale * residual
        return residuals
