"""Values on a device: where arrays live is said once, when they are placed there; what computes follows its inputs."""

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

    A ``torch.device`` among the fields becomes this one: it says where what is derived later is made.
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
