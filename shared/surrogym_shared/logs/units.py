"""Detect columns of a log that lie outside the ranges of a specification, or that seem to be in another unit."""

from __future__ import annotations

import numpy as np

from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.rows import SLACK
from surrogym_shared.logs.table import Floats
from surrogym_shared.spec import EnvironmentSpec, limits

BEYOND = 20.0  # a log is refused if half of a column lies this many widths of the coordinate's range outside the range
NARROW = 0.25  # if a log covers less than this share of a coordinate's range, the report notes it
MOST_OUTSIDE = 0.1  # if more than this share of a log's rows lies outside a coordinate's range, the report notes it
FEWEST = 8  # if the surrogate has fewer rewards of real steps, the rewards of a log are not compared with them


def require_units(q: Floats, spec: EnvironmentSpec, which: str = "") -> None:
    """Check that states q (n, C) lie in the sampling ranges of their coordinates, and seem to be in their units.

    A log outside the sampling ranges says nothing about the states for which the surrogate is made. Angles are not
    checked, because they wrap.

    Args:
        q: the states.
        spec: specification with the ranges of the coordinates.
        which: words before the name of a coordinate in a message, such as "next ".

    Raises:
        UnusableLog: the middle half of a column lies outside the coordinate's range, or is far wider than the range.
    """
    for index, coordinate in enumerate(spec.coordinates):
        column = q[np.isfinite(q[:, index]), index]
        if coordinate.kind == "angle" or not len(column):
            continue
        low, high = limits(coordinate.sampling)
        first, last = np.quantile(column, [0.25, 0.75])
        half = f"{which}{coordinate.name}: half of the log lies between {first:.4g} and {last:.4g}"
        unit = "is the column in another unit? Convert it, or name another column (--map)"
        far = BEYOND * (high - low)
        if first > high + far or last < low - far or last - first > far:
            raise UnusableLog(f"{half}, the coordinate's range is {low:.4g} to {high:.4g}: {unit}")
        rounding = SLACK * max(high - low, abs(low), abs(high))
        if first > high + rounding or last < low - rounding:
            raise UnusableLog(
                f"{half}, outside its sampling range of {low:.4g} to {high:.4g}: {unit}. If the values are right, "
                "widen the sampling range in a new specification (--spec)"
            )


def unit_notes(q: Floats, spec: EnvironmentSpec) -> list[str]:
    """Return a sentence for each column of states q (n, C) that may be in another unit, because it covers a small part
    of its coordinate's sampling range, or many of its rows lie outside the range."""
    notes = []
    for index, coordinate in enumerate(spec.coordinates):
        column = q[np.isfinite(q[:, index]), index]
        low, high = limits(coordinate.sampling)
        if coordinate.kind == "angle" or not len(column) or high <= low:
            continue
        first, last = float(column.min()), float(column.max())
        rounding = SLACK * max(high - low, abs(low), abs(high))
        outside = float(np.mean((column < low - rounding) | (column > high + rounding)))
        covered = (last - first) / (high - low)
        if covered < NARROW or outside > MOST_OUTSIDE:
            share = f"{outside:.0%} of the rows lie outside" if outside > MOST_OUTSIDE else f"{100 * covered:.2g} % of"
            notes.append(
                f"{coordinate.name}: the log lies between {first:.4g} and {last:.4g}, {share} its sampling range of "
                f"{low:.4g} to {high:.4g}: if the column is in another unit, convert it"
            )
    return notes


def require_reward_unit(paid: Floats, known: Floats, name: str) -> None:
    """Check that the rewards of a log seem to be in the same unit as those of a surrogate's samples.

    Nothing is checked if there are few samples, because their rewards may be small by chance, or if all their rewards
    are 0.

    Args:
        paid: rewards of the log, (m,).
        known: rewards of the samples, (n,).
        name: name of the surrogate.

    Raises:
        UnusableLog: the middle half of ``paid`` lies beyond 20 times the largest absolute value of ``known``, or is
            wider than that.
    """
    largest = float(np.abs(known).max(initial=0.0))
    if len(known) < FEWEST or largest == 0:
        return
    first, last = np.quantile(paid, [0.25, 0.75])
    far = BEYOND * largest
    if first > far or last < -far or last - first > far:
        raise UnusableLog(
            f"reward: half of the log lies between {first:.4g} and {last:.4g}, the samples of {name!r} have rewards of "
            f"{known.min():.4g} to {known.max():.4g}: is the column in another unit? Convert it, or name another "
            "column (--map)"
        )
