"""Tensors that are computed once and cached."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import torch

T = TypeVar("T")


def cached(make: Callable[[Any], T]) -> cached_property[T]:
    """``cached_property`` for tensors, computed outside inference mode, so that autograd can use them later."""
    return cached_property(torch.inference_mode(False)(make))
