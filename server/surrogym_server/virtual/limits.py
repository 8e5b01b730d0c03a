"""Limits of virtual rewards: what lies far beyond every sample is the model's invention."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.virtual.environment import LaneTransition

Limits = tuple[float, float]


def reward_limits(low: float, high: float) -> Limits:
    """Limits of virtual rewards, from the least and the largest reward of all samples: as far beyond them as they lie
    apart, or from 0, whichever is more. They always include 0."""
    room = max(high - low, abs(low), abs(high))
    return low - room, high + room


def within(limits: Limits | None, transition: LaneTransition) -> LaneTransition:
    """A transition whose mean rewards keep to the limits; a penalty comes off after that.

    What a lane is paid for leaving the sampling range is none of the model's rewards, and stays.
    """
    if limits is None:
        return transition
    mean, (low, high) = transition.reward_mean, limits
    if np.minimum.reduce(mean) >= low and np.maximum.reduce(mean) <= high:
        return transition
    kept: NDArray[Any] = np.clip(mean, low, high)
    if transition.left is not None:
        kept = np.where(transition.left, mean, kept)
    if (kept == mean).all():
        return transition
    return replace(transition, reward_mean=kept, reward=transition.reward - mean + kept)
