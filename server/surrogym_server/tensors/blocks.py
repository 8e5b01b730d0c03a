"""Computation in blocks of rows, so that data stay in the cache and memory is bounded at any batch size."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def in_blocks(rows: int, function: Callable[..., tuple[Tensor, ...]], *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """Apply ``function`` to the tensors (m, ...), at most ``rows`` rows at a time, and join its results.

    A tensor that is None is None in every block.
    """
    count = next(len(t) for t in tensors if t is not None)
    if count <= rows:
        return function(*tensors)
    parts = [
        function(*(None if t is None else t[begin : begin + rows] for t in tensors)) for begin in range(0, count, rows)
    ]
    return tuple(torch.cat(joined) for joined in zip(*parts, strict=True))
