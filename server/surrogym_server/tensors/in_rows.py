"""Tensors in the order of memory that stored ones have."""

from __future__ import annotations

import torch
from torch import Tensor


def in_rows(tensor: Tensor) -> Tensor:
    """A copy that lies in rows, without a gradient. What LAPACK returns lies in columns, and even the stride of a
    dimension of one entry changes the last bits of a product: a fresh model would differ from a loaded one."""
    return tensor.detach().clone(memory_format=torch.contiguous_format)
