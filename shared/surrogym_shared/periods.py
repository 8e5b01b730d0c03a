"""Comparison of the intervals between real steps with the declared sampling period."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from surrogym_shared.spec import EnvironmentSpec

FEWEST = 5  # from fewer intervals, the clock of the original environment is not known
# An original environment whose median interval differs from the period by more than this share of it is a simulator,
# which is faster or slower than the clock.
REAL_TIME = 0.2
OFF = 0.5  # an interval that differs from the period by at least this share of it is named


def irregular(spec: EnvironmentSpec, intervals: Sequence[float], judged: int) -> str:
    """Say how many of the last ``judged`` intervals are off by half of the sampling period or more, and name the one
    that is farthest off. Returns "" if there is none, if no period is declared, or if the intervals are those of a
    simulator.

    Args:
        spec: the specification.
        intervals: the seconds from one step of a rollout to the next, of one or several rollouts.
        judged: number of the last intervals to judge; the others only tell a machine from a simulator.

    Examples:
        "2 of 40 intervals between steps are off by half of the sampling period or more, such as 0.11 s, where the
        specification declares 0.05 s"
    """
    period = spec.sampling_period
    if period is None or len(intervals) < FEWEST or abs(median(intervals) - period) > REAL_TIME * period:
        return ""
    off = [one for one in intervals[len(intervals) - judged :] if abs(one - period) >= OFF * period]
    if not off:
        return ""
    farthest = max(off, key=lambda one: abs(one - period))
    return (
        f"{len(off)} of {judged} intervals between steps are off by half of the sampling period or more, "
        f"such as {farthest:.3g} s, where the specification declares {period:g} s"
    )
