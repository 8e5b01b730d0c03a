"""Helpers for tensors: move to a device, cache, compute in blocks of rows, copy in row order, transform inputs.

Tensors are placed on a device once; computations run on the device of their inputs.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.errors import Overloaded, Unavailable

logger = logging.getLogger(__name__)

T = TypeVar("T")

CPU = torch.device("cpu")
GPU_BLOCK = 1 << 25  # greatest number of covariances that a GPU computes at once; one array of them takes 256 MiB
FAILURE = getattr(torch, "AcceleratorError", ())  # the class of a GPU's errors since torch 2.8
STEEPEST = 2.0  # a fit searches rates g of the transformation ``bend`` between minus this number and this number
EDGE = 2.0  # the transformation ``bend`` of inputs z is exponential for |z| up to this number


def to_device(value: T, device: torch.device) -> T:
    """Return a copy of ``value`` with all its tensors on a device, also those in dataclasses, tuples and mappings.

    Each ``torch.device`` in the value is replaced by ``device`` too, because later tensors are created there.
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


def sent(values: NDArray[Any], device: torch.device) -> Tensor:
    """Return an array as a tensor on a device. The program does not wait for the copy; on the CPU nothing is copied."""
    tensor = torch.from_numpy(values)
    if device == CPU:
        return tensor
    # While CUDA copies from pinned memory, the program goes on. For a copy from other memory, it would wait.
    return (tensor.pin_memory() if device.type == "cuda" else tensor).to(device, non_blocking=True)


def fetched(*tensors: Tensor | None) -> tuple[Any, ...]:
    """Return tensors of one device as NumPy arrays, and None for None. The program waits for the device once, for one
    copy of all tensors; on the CPU nothing is copied."""
    if all(t is None or t.device == CPU for t in tensors):
        return tuple(None if t is None else t.numpy() for t in tensors)
    # The widest numbers come first, so that each array begins at a multiple of its numbers' size.
    given = sorted((t for t in tensors if t is not None), key=lambda t: -t.element_size())
    data = torch.cat([t.flatten().view(torch.uint8) for t in given]).cpu().numpy()
    arrays, begin = {}, 0
    for t in given:
        raw = data[begin : (begin := begin + t.nbytes)]
        arrays[id(t)] = raw.view(str(t.dtype).removeprefix("torch.")).reshape(t.shape)
    return tuple(None if t is None else arrays[id(t)] for t in tensors)


def free_bytes(device: torch.device) -> int | None:
    """Return the memory of a GPU that this program can still take, in bytes; None for the CPU."""
    if device.type != "cuda":
        return None
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def gpu_failure(error: BaseException) -> Unavailable | None:
    """Return what to tell a user of an error that torch raised because a GPU failed, and log it; None for any other
    error."""
    if isinstance(error, torch.OutOfMemoryError):
        return Overloaded(
            "the GPU has too little free memory for this request, and nothing was changed: close other sessions, or "
            "open one with fewer lanes or particles"
        )
    said = str(error.args[0] if error.args else error).partition("\n")[0]
    if isinstance(error, FAILURE) or (isinstance(error, RuntimeError) and said.startswith("CUDA error")):
        logger.error("the GPU failed: %s", said)
        return Unavailable(
            f"the GPU failed ({said}), so this server's sessions can't go on: start the server again, then open new "
            "sessions; samples, models and policies are stored"
        )
    return None


@contextmanager
def gpu_calls() -> Iterator[None]:
    """Raise what ``gpu_failure`` returns in the place of an error that torch raised because a GPU failed."""
    try:
        yield
    except RuntimeError as error:
        if failure := gpu_failure(error):
            raise failure from error
        raise


@lru_cache(maxsize=1_024)
@torch.inference_mode(False)
def constant(values: tuple[Any, ...], device: torch.device) -> Tensor:
    """Return numbers (nested tuples) as a float64 tensor on a device, copied there once. It must not be changed."""
    return torch.tensor(values, dtype=torch.float64, device=device)


def cached(make: Callable[[Any], T]) -> cached_property[T]:
    """Decorate a method that returns tensors, to make it a ``cached_property``. The method runs outside torch's
    inference mode, so that autograd can use the cached tensors later."""
    return cached_property(torch.inference_mode(False)(make))


def in_blocks(rows: int, function: Callable[..., tuple[Tensor, ...]], *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """Apply ``function`` to blocks of at most ``rows`` of the m rows of ``tensors`` (m, ...). Concatenate the results.

    An argument that is None is passed as None with every block.
    """
    count = next(len(t) for t in tensors if t is not None)
    if count <= rows:
        return function(*tensors)
    parts = [
        function(*(None if t is None else t[begin : begin + rows] for t in tensors)) for begin in range(0, count, rows)
    ]
    return tuple(torch.cat(joined) for joined in zip(*parts, strict=True))


def in_rows(tensor: Tensor) -> Tensor:
    """Copy a tensor to row-major (C-contiguous) memory, without its gradient.

    LAPACK returns column-major tensors, and strides change the last bits of a product. Without the copy, a fitted
    model and the same model loaded from a file would differ in these bits.
    """
    return tensor.detach().clone(memory_format=torch.contiguous_format)


def bend(z: Tensor, rates: Tensor) -> Tensor:
    """Transform inputs z (..., d) with rates g (d,) by w(z) = (e^(g z) - 1) / g, and by w(z) = z where g is 0.

    Beyond |z| = ``EDGE``, where the exponential could overflow, w is linear on the steep side and constant on the flat
    side.
    """
    size, sign = rates.abs(), rates.sign()
    along = (z * sign).clamp_min(-EDGE)  # z, with its sign changed where the rate is negative; constant below -EDGE
    beyond = (along - EDGE).clamp_min(0)
    bent = torch.expm1(size * along.clamp_max(EDGE)) / torch.where(size == 0, 1.0, size)
    return torch.where(rates == 0, z, sign * (bent + torch.exp(size * EDGE) * beyond))


def amplitude(w: Tensor, rates: Tensor) -> Tensor:
    """Return the product over d inputs z_j of e^(g_j z_j) = 1 + g_j w_j, shape (...).

    Args:
        w: inputs (..., d), transformed by ``bend`` with the same rates.
        rates: the rates g (d,).
    """
    grown: Tensor = (1 + w * rates).prod(-1)
    return grown
