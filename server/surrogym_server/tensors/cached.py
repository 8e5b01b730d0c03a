"""Tensors that are made once and used for ever, whoever asks first."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import torch

T = TypeVar("T")


def cached(make: Callable[[Any], T]) -> cached_property[T]:
    """``cached_property`` for tensors. A step runs in torch's inference mode, whose tensors no gradient may go through;
    what a step happens to make first must serve a later gradient all the same."""
    return cached_property(torch.inference_mode(False)(make))
