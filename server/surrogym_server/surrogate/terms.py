"""Terms: sums of c phi(q) with phi in {1, a.q, sin(a.q), cos(a.q)}, evaluated as three matrix products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Function = Literal["one", "linear", "sin", "cos"]


@dataclass(frozen=True)
class Part:
    """coefficient * phi(weights . q), weights (C,)."""

    function: Function
    coefficient: float
    weights: tuple[float, ...]


@dataclass(frozen=True)
class Term:
    parts: tuple[Part, ...]
    low: float = -torch.inf
    high: float = torch.inf


@dataclass(frozen=True)
class TermSet:
    """T terms over q (..., C), compiled: value = constant + q A + sin(q W) S + cos(q W) R, clipped."""

    constant: Tensor  # (T,)
    linear: Tensor  # (C, T)
    frequencies: Tensor  # (C, P)
    sine: Tensor  # (P, T)
    cosine: Tensor  # (P, T)
    low: Tensor  # (T,)
    high: Tensor  # (T,)

    def __call__(self, q: Tensor) -> Tensor:
        """Values at q (..., C), shape (..., T)."""
        value = self.constant + q @ self.linear
        if self.frequencies.shape[1]:
            phase = q @ self.frequencies
            value = value + phase.sin() @ self.sine + phase.cos() @ self.cosine
        return torch.clamp(value, self.low, self.high)

    def to(self, device: torch.device) -> TermSet:
        return TermSet(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


def compile_terms(terms: Sequence[Term], coordinates: int) -> TermSet:
    """Compile terms over C coordinates. Equal frequencies are computed once."""
    count = len(terms)
    constant = torch.zeros(count, dtype=torch.float64)
    linear = torch.zeros(coordinates, count, dtype=torch.float64)
    frequencies = sorted({p.weights for t in terms for p in t.parts if p.function in ("sin", "cos")})
    sine = torch.zeros(len(frequencies), count, dtype=torch.float64)
    cosine = torch.zeros_like(sine)
    for column, term in enumerate(terms):
        for part in term.parts:
            match part.function:
                case "one":
                    constant[column] += part.coefficient
                case "linear":
                    linear[:, column] += part.coefficient * torch.tensor(part.weights, dtype=torch.float64)
                case "sin":
                    sine[frequencies.index(part.weights), column] += part.coefficient
                case "cos":
                    cosine[frequencies.index(part.weights), column] += part.coefficient
    return TermSet(
        constant,
        linear,
        torch.tensor(frequencies, dtype=torch.float64).reshape(-1, coordinates).T.contiguous(),
        sine,
        cosine,
        torch.tensor([t.low for t in terms], dtype=torch.float64),
        torch.tensor([t.high for t in terms], dtype=torch.float64),
    )
