"""Convert the spaces in a server's reply to spaces of Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from surrogym_shared.wire import BoxSpace, DiscreteSpace, MultiDiscreteSpace


def space(wire: BoxSpace | DiscreteSpace | MultiDiscreteSpace) -> gymnasium.Space[Any]:
    """Return the Gymnasium space of one lane: float32 Box, Discrete or MultiDiscrete."""
    match wire:
        case BoxSpace():
            return gymnasium.spaces.Box(_filled(wire.low, -np.inf), _filled(wire.high, np.inf), dtype=np.float32)
        case DiscreteSpace():
            return gymnasium.spaces.Discrete(wire.n)
        case MultiDiscreteSpace():
            return gymnasium.spaces.MultiDiscrete(wire.nvec)


def _filled(limits: Sequence[float | None], unbounded: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.array([unbounded if limit is None else limit for limit in limits], dtype=np.float32)
