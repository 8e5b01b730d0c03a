"""Limits of virtual rewards: values far beyond all samples are errors of the model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.virtual.environment import LaneTransition

Limits = tuple[float, float]


def reward_limits(low: float, high: float) -> Limits:
    """Limits of virtual rewards, from the smallest and largest reward of all samples. On each side they lie beyond
    these by the distance between them, or by their distance from 0, whichever is larger. They always include 0."""
    room = max(high - low, abs(low), abs(high))
    return low - room, high + room


def within(limits: Limits | None, transition: LaneTransition) -> LaneTransition:
    """Clip the mean rewards of a transition to the limits; a penalty is subtracted after that.

    The outside reward is not predicted by the model, so it is not clipped.
    """
    if limits is None:
        return transition
    mean, (low, high) = transition.reward_mean, limits
    if np.minimum.reduce(mean) >= low and np.maximum.reduce(mean) <= high:
        return transition
    clipped: NDArray[Any] = np.clip(mean, low, high)
    if transition.left is not None:
        clipped = np.where(transition.left, mean, clipped)
    if (clipped == mean).all():
        return transition
    return replace(transition, reward_mean=clipped, reward=transition.reward - mean + clipped)
