"""Terms: sums of c phi(q) with phi in {1, a.q, sin(a.q), cos(a.q)}, evaluated as two matrix products."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import linear

from surrogym_shared.kinds import Function
from surrogym_shared.spec import Term, ends_of


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


def compile_terms(terms: Sequence[Term], names: Sequence[str]) -> TermSet:
    """Compile terms, functions of the C coordinates ``names``, to a ``TermSet``. If several sines and cosines have the
    same argument, the argument is computed once."""
    sums = [parts_of(term, names) for term in terms]
    frequencies = sorted({weights for parts in sums for function, _, weights in parts if function in ("sin", "cos")})
    first = {"sin": len(names), "cos": len(names) + len(frequencies)}
    constant = torch.zeros(len(terms), dtype=torch.float64)
    coefficients = torch.zeros(len(terms), len(names) + 2 * len(frequencies), dtype=torch.float64)
    for row, parts in enumerate(sums):
        for function, coefficient, weights in parts:
            if function == "one":
                constant[row] += coefficient
            elif function == "linear":
                coefficients[row, : len(names)] += coefficient * torch.tensor(weights, dtype=torch.float64)
            else:
                coefficients[row, first[function] + frequencies.index(weights)] += coefficient
    ends = [ends_of(term.low, term.high) for term in terms]
    clipped = any(math.isfinite(end) for both in ends for end in both)
    low, high = torch.tensor(ends, dtype=torch.float64).T.contiguous() if clipped else (None, None)
    return TermSet(
        constant,
        torch.tensor(frequencies, dtype=torch.float64).reshape(-1, len(names)).T.contiguous(),
        coefficients,
        low,
        high,
    )


def parts_of(term: Term, names: Sequence[str]) -> tuple[tuple[Function, float, tuple[float, ...]], ...]:
    """Return the function and the coefficient of each part of a term, and the weights (C,) of the C coordinates
    ``names`` in its argument."""
    return tuple((p.function, p.coefficient, tuple(p.weights.get(name, 0.0) for name in names)) for p in term.parts)
