"""Limits of rewards of virtual steps. A predicted reward far beyond those of all samples is an error of the model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.virtual.environment import LaneTransition

Limits = tuple[float, float]


def reward_limits(low: float, high: float) -> Limits:
    """Return the lower and upper limit of the mean rewards of virtual steps: ``low - w`` and ``high + w``.

    ``low`` and ``high`` are the smallest and largest reward of all samples, and w is the largest of ``high - low``,
    ``|low|`` and ``|high|``. So the range between the limits always includes 0.
    """
    room = max(high - low, abs(low), abs(high))
    return low - room, high + room


def within(limits: Limits | None, transition: LaneTransition) -> LaneTransition:
    """Return the transition with its mean rewards clipped to the limits. Penalties are subtracted from the clipped
    rewards.

    The outside reward of an episode that ended early is not clipped, because it is declared, not predicted.
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
