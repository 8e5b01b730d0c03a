"""Limits of virtual rewards: values far beyond all samples are errors of the model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.virtual.environment import LaneTransition

Limits = tuple[float, float]


def reward_limits(low: float, high: float) -> Limits:
    """Return the limits of virtual rewards, given the smallest and the largest reward of all samples.

    They lie beyond these rewards by their difference or by their largest absolute value, whichever is larger, so they
    always include 0.
    """
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
