"""Terms: sums of c phi(q) with phi in {1, a.q, sin(a.q), cos(a.q)}, evaluated as two matrix products."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import linear

from surrogym_shared.kinds import Function


@dataclass(frozen=True)
class PartDefinition:
    """Part of a term: coefficient * function(weights . q), with a weight for each coordinate (C,)."""

    function: Function
    coefficient: float
    weights: tuple[float, ...]


@dataclass(frozen=True)
class TermDefinition:
    """Function of the coordinates: a sum of parts, clipped to [low, high]."""

    parts: tuple[PartDefinition, ...]
    low: float = -torch.inf
    high: float = torch.inf


@dataclass(frozen=True)
class TermSet:
    """T compiled terms over q (..., C): value = constant + [q, sin(q W), cos(q W)] A, clipped."""

    constant: Tensor  # (T,) constant part of each of the T terms
    frequencies: Tensor  # W (C, P): weights of the C coordinates in the argument of each of P sines and P cosines
    coefficients: Tensor  # A^T (T, C + 2 P): coefficients of the C coordinates, P sines and P cosines in each term
    low: Tensor | None  # (T,) each term is raised to this value if it is below; None if no term is clipped
    high: Tensor | None  # (T,) each term is lowered to this value if it is above; None if no term is clipped

    def __call__(self, q: Tensor) -> Tensor:
        """Return the values (..., T) of all T terms at q (..., C)."""
        basis = q
        if self.frequencies.shape[1]:
            phase = q @ self.frequencies
            basis = torch.cat([q, phase.sin(), phase.cos()], -1)
        value = linear(basis, self.coefficients, self.constant)
        return value if self.low is None else torch.clamp(value, self.low, self.high)


def compile_terms(terms: Sequence[TermDefinition], coordinates: int) -> TermSet:
    """Compile terms, functions of C coordinates, to a ``TermSet``. If several sines and cosines have the same argument,
    the argument is computed once."""
    frequencies = sorted({p.weights for t in terms for p in t.parts if p.function in ("sin", "cos")})
    first = {"sin": coordinates, "cos": coordinates + len(frequencies)}
    constant = torch.zeros(len(terms), dtype=torch.float64)
    coefficients = torch.zeros(len(terms), coordinates + 2 * len(frequencies), dtype=torch.float64)
    for row, term in enumerate(terms):
        for part in term.parts:
            if part.function == "one":
                constant[row] += part.coefficient
            elif part.function == "linear":
                weights = torch.tensor(part.weights, dtype=torch.float64)
                coefficients[row, :coordinates] += part.coefficient * weights
            else:
                coefficients[row, first[part.function] + frequencies.index(part.weights)] += part.coefficient
    clipped = any(math.isfinite(limit) for t in terms for limit in (t.low, t.high))
    return TermSet(
        constant,
        torch.tensor(frequencies, dtype=torch.float64).reshape(-1, coordinates).T.contiguous(),
        coefficients,
        torch.tensor([t.low for t in terms], dtype=torch.float64) if clipped else None,
        torch.tensor([t.high for t in terms], dtype=torch.float64) if clipped else None,
    )
