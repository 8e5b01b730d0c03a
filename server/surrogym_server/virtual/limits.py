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

    The limits lie beyond the smallest and the largest reward, by the difference of these two or by the larger of their
    absolute values, whichever is greater. So the range between the limits always includes 0.
    """
    room = max(high - low, abs(low), abs(high))
    return low - room, high + room


def within(limits: Limits | None, transition: LaneTransition) -> LaneTransition:
    """Return the transition with its mean rewards clipped to the limits. Penalties are subtracted from the clipped
    rewards.

    The outside reward, which an episode gets that ended early, is not clipped, because the model does not predict it.
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
