"""Tensors in general: their device, caching, blocks of rows, order in memory, and inputs that are bent.

Arrays are placed on a device once; computations follow their inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")

CPU = torch.device("cpu")
STEEPEST = 2.0  # largest rate of a bent input
EDGE = 2.0  # |z| beyond which ``bend`` follows no exponential


def to_device(value: T, device: torch.device) -> T:
    """The same value with every tensor on a device, through frozen dataclasses, tuples and mappings.

    A ``torch.device`` among the fields is replaced too: it is the device of values that are derived later.
    """
    result: Any = value
    match value:
        case Tensor():
            result = value.to(device)
        case torch.device():
            result = device
        case tuple():
            result = tuple(to_device(entry, device) for entry in value)
        case Mapping():
            result = {key: to_device(entry, device) for key, entry in value.items()}
        case _ if is_dataclass(value) and not isinstance(value, type):
            moved = {field.name: to_device(getattr(value, field.name), device) for field in fields(value)}
            result = replace(value, **moved)
    found: T = result
    return found


def cached(make: Callable[[Any], T]) -> cached_property[T]:
    """``cached_property`` for tensors, computed outside inference mode, so that autograd can use them later."""
    return cached_property(torch.inference_mode(False)(make))


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


def in_rows(tensor: Tensor) -> Tensor:
    """A copy in row order, without a gradient.

    LAPACK returns columns, and even the stride of a dimension of size one changes the last bits of a product. So a new
    model would differ from a loaded one.
    """
    return tensor.detach().clone(memory_format=torch.contiguous_format)


def bend(z: Tensor, rates: Tensor) -> Tensor:
    """w(z) = (e^(g z) - 1) / g of inputs z (..., d) and rates g (d,); z where the rate is 0.

    Beyond ``EDGE`` an exponential would overflow. There w is a line on the steep side, and constant on the flat side.
    """
    size, sign = rates.abs(), rates.sign()
    along = (z * sign).clamp_min(-EDGE)  # grows towards the steep side
    beyond = (along - EDGE).clamp_min(0)
    bent = torch.expm1(size * along.clamp_max(EDGE)) / torch.where(size == 0, 1.0, size)
    return torch.where(rates == 0, z, sign * (bent + torch.exp(size * EDGE) * beyond))


def amplitude(w: Tensor, rates: Tensor) -> Tensor:
    """a(z) = prod_j e^(g_j z_j) = prod_j (1 + g_j w_j) of bent inputs w(z) (..., d) and rates g (d,), (...)."""
    grown: Tensor = (1 + w * rates).prod(-1)
    return grown
