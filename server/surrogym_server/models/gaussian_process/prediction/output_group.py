"""Outputs predicted together from one set of features: their means, and differences from these."""

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
    """Places of the draws of one output's function. W weights of all outputs of a model."""

    column: int
    span: slice  # of the W weights
    inputs: Tensor  # columns of x
    scale: float
    pathwise: Pathwise


@dataclass(frozen=True)
class Grown:
    """An output whose amplitude grows along its inputs."""

    column: int
    inputs: Tensor  # columns of x
    rates: Tensor  # of these
    centre: float


@dataclass(frozen=True)
class OutputGroup:
    """Some outputs of a model. It fills their columns of O, and leaves the others 0."""

    encoder: Encoder
    serving: Serving
    noise_std: Tensor  # (O,) learned noise, in each output's unit
    drawn: tuple[Drawn, ...]  # by output, except constant ones, which have no function to draw
    end: int  # end of its draws' weights
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
        """Compile outputs for ``columns`` of them. Their draws' weights start at ``begin``."""
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
        """Values at features x (m, d), and the latent standard deviations of the wanted columns, (m, O) each.

        A value is the posterior's mean. ``kick`` (m, O) moves it by latent standard deviations, ``process`` (m, O) by
        standard deviations of the noise. With ``paths`` (m, W) it is that of a posterior sample, one for each row.
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
