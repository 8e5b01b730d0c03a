"""Tensors with the order in memory of stored ones."""

from __future__ import annotations

import torch
from torch import Tensor


def in_rows(tensor: Tensor) -> Tensor:
    """A copy in row order, without a gradient.

    LAPACK returns columns, and even the stride of a dimension of size one changes the last bits of a product. So a new
    model would differ from a loaded one.
    """
    return tensor.detach().clone(memory_format=torch.contiguous_format)
