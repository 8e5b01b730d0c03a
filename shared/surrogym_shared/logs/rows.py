"""Rows of a log as numbers, with the faults that are visible in a row alone, without its neighbours; and columns that
lie outside the ranges of a specification, or that seem to be in another unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_shared.logs.columns import EITHER_END, SECONDS, Roles, heading
from surrogym_shared.logs.table import Bools, Floats, Ints, Table, UnusableLog, flags, groups, numbers, times
from surrogym_shared.spec import EnvironmentSpec, limits

SLACK = 1e-6  # a value may lie outside its range by this share of the range's width, because of rounding to float32
Ends = Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Rows:
    """n rows of a log with C coordinates and F action entries.

    Attributes:
        q: states, (n, C).
        u: actions, (n, F).
        following: next states, (n, C); None if the log has no columns of them.
        reward: rewards, (n,); None without a column.
        terminated, truncated: whether the episode ended with the row, (n,).
        episode: number of the episode, (n,); None without a column.
        time: times, (n,); None without a column.
        faults: reason for each row that can't be used, by the row's index.
        sound: whether the row's state can be used, (n,). In a row that can't be used for another reason, the state can
            still be the next state of the row before.
    """

    roles: Roles
    lines: Ints
    q: Floats
    u: Floats
    following: Floats | None
    reward: Floats | None
    terminated: Bools
    truncated: Bools
    episode: Ints | None
    time: Floats | None
    faults: dict[int, str]
    sound: Bools

    def __len__(self) -> int:
        return len(self.lines)


def rows_of(table: Table, roles: Roles, spec: EnvironmentSpec | None = None) -> Rows:
    """Convert the rows of a table to numbers, and check them against the limits of the specification. Without a
    specification, check them against the limits in the mapping."""
    faults: dict[int, list[str]] = {row: [reason] for row, reason in table.faults.items()}
    whole = np.ones(len(table), dtype=np.bool_)
    whole[list(table.faults)] = False
    q, state_faults = _matrix(table, roles.state, _state_limits(roles, spec))
    u, action_faults = _matrix(table, roles.action, _action_limits(roles, spec), roles.choices)
    sound = whole.copy()
    sound[list(state_faults)] = False
    of_columns = [state_faults, action_faults]
    following = reward = time = None
    if roles.following:
        columns = {name: roles.following[name] for name in roles.state}
        following, faulty = _matrix(table, columns, _state_limits(roles, spec))
        of_columns.append(faulty)
    if roles.reward is not None:
        reward, faulty = numbers(roles.reward, table.columns[roles.reward])
        of_columns.append(faulty)
    if roles.time is not None:
        time, faulty = times(roles.time, table.columns[roles.time])
        of_columns.append(faulty)
    terminated, truncated = (np.zeros(len(table), dtype=np.bool_) for _ in range(2))
    if roles.terminated is not None:
        terminated, faulty = flags(roles.terminated, table.columns[roles.terminated])
        of_columns.append(faulty)
    if roles.truncated is not None:
        truncated, faulty = flags(roles.truncated, table.columns[roles.truncated])
        of_columns.append(faulty)
        if heading(roles.terminated or "").plain in EITHER_END:
            terminated &= ~truncated
    for one in of_columns:
        for row, reason in one.items():
            if whole[row]:
                faults.setdefault(row, []).append(reason)
    episode = None if roles.episode is None else groups(table.columns[roles.episode])
    reasons = {row: "; ".join(faults[row]) for row in sorted(faults)}
    return Rows(
        roles, table.lines, q, u, following, reward, terminated, truncated, episode, time, reasons, sound
    )  # fmt: skip


def _matrix(
    table: Table, columns: Mapping[str, str], ends: Ends, choices: Mapping[str, tuple[float, ...]] | None = None
) -> tuple[Floats, dict[int, str]]:
    """Convert k columns of n rows to numbers (n, k), and values of declared ``choices`` to the numbers of the choices
    from 0. Also returns the first fault of each row, by the row's index."""
    values, faults = [], dict[int, str]()
    for name, column in columns.items():
        cells, faulty = numbers(column, table.columns[column])
        if choices and name in choices:
            cells, unknown = _numbered(column, cells, choices[name])
            faulty = unknown | faulty
        values.append(cells)
        for row, reason in (_beyond(column, cells, *ends.get(name, (None, None))) | faulty).items():
            faults.setdefault(row, reason)
    return np.stack(values, 1), faults


def _numbered(column: str, cells: Floats, choices: tuple[float, ...]) -> tuple[Floats, dict[int, str]]:
    """Convert codes of choices to the numbers (n,) of the choices from 0. Also return a reason for each cell that is
    not a choice, by the row's index."""
    values = np.array(choices)
    same = cells[:, None] == values
    numbered = np.where(same.any(1), same.argmax(1), np.nan)
    words = f"{column}: expected one of {values.tolist()}"
    return numbered, {int(row): f"{words}, got {cells[row]:g}" for row in np.flatnonzero(~same.any(1))}


def _beyond(column: str, cells: Floats, low: float | None, high: float | None) -> dict[int, str]:
    """Return a reason for each cell outside its limits, by the row's index."""
    least, most = -np.inf if low is None else low, np.inf if high is None else high
    ends = [end for end in (least, most) if np.isfinite(end)]
    width = most - least if len(ends) == 2 else max([1.0, *map(abs, ends)])
    beyond = (cells < least - SLACK * width) | (cells > most + SLACK * width)
    words = f"expected a value in [{least:g}, {most:g}]"
    return {int(row): f"{column}: {words}, got {cells[row]:g}" for row in np.flatnonzero(beyond)}


def _state_limits(roles: Roles, spec: EnvironmentSpec | None) -> Ends:
    if spec is None:
        return roles.limits
    bounded = {c.name: c.bounds for c in spec.coordinates if c.bounds is not None}
    return {name: (bounds.low, bounds.high) for name, bounds in bounded.items()}


def _action_limits(roles: Roles, spec: EnvironmentSpec | None) -> Ends:
    if spec is None:
        return roles.limits
    return dict(zip(roles.action, spec.action.ranges, strict=True))


BEYOND = 20.0  # a log is refused if half of a column lies this many widths of the coordinate's range outside the range
OFF_PERIOD = 0.1  # steps are refused if their interval differs from the sampling period by more than this share
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


def require_period(roles: Roles, interval: float | None, period: float | None) -> None:
    """Check that the interval between two rows is the sampling period of a specification.

    Args:
        roles: roles of the columns, with the unit of the clock. A clock without a unit may count seconds, or milli-,
            micro- or nanoseconds.
        interval: median interval between two rows, in the unit of the clock; None without a clock.
        period: sampling period of the specification in seconds; None if it declares none.

    Raises:
        UnusableLog: the interval is another one.
    """
    if period is None or not interval or roles.time is None:
        return
    seconds = SECONDS.get(roles.units.get(roles.time, ""))
    units = [1.0, 1e-3, 1e-6, 1e-9] if seconds is None else [seconds]
    if not any(abs(interval * unit / period - 1) <= OFF_PERIOD for unit in units):
        raise UnusableLog(
            f"expected a step every {period:g} s, the sampling_period of the specification, got one every "
            f"{interval:g} in the column {roles.time!r}: record the log at this period, or leave the column out of a "
            "mapping file (--map) if it is no clock"
        )


def impossible(spec: EnvironmentSpec, state: Sequence[float]) -> str | None:
    """Return a sentence about the coordinate of a state (C,) that is so far outside its range that its unit or
    measurement must be wrong; None if no coordinate is."""
    for coordinate, value in zip(spec.coordinates, state, strict=True):
        low, high = limits(coordinate.sampling)
        if coordinate.kind == "angle" or low == high:
            continue
        far = BEYOND * (high - low)
        if not low - far <= value <= high + far:
            return f"{coordinate.name}: expected a value near its range of {low:.4g} to {high:.4g}, got {value:.6g}"
    return None


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
        UnusableLog: the middle half of ``paid`` lies beyond 20 times the largest absolute value of ``known``, or its
            width exceeds this value.
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
