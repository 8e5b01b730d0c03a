"""Values moved to a device. Arrays are placed on a device once; computations follow their inputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")

CPU = torch.device("cpu")


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
