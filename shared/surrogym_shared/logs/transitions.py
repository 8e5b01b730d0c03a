"""Convert rows of a log to transitions (steps): find the row with each row's next state, and rows that contradict
others."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from surrogym_shared.logs.clock import GAP, Ticks, episodes_of, repeated, ticks_of
from surrogym_shared.logs.rows import Rows
from surrogym_shared.logs.table import Bools, Floats, Ints

# Two rows are one step apart if the time between them differs from the usual interval by at most this share of it.
ONE_INTERVAL = 0.5


@dataclass(frozen=True)
class Transitions:
    """The m usable steps of a log, in the order of the log.

    Attributes:
        row: index of each step's row in the log, (m,).
        q, u, q_next: state (m, C), action (m, F) and next state (m, C).
        reward: rewards, (m,); None if the log has none.
        terminated, truncated: whether the episode ended with the step, (m,).
        first: whether an episode of the log begins with the step, (m,).
        episodes: number of rows of each episode.
        rejected: reason for each row that was set aside, by the row's index.
        ends: number of rows that give no step, because an episode ends there or a gap in time follows.
        interval: median time between two rows, in the unit of the time column; None without such a column.
        lost_ends: number of rows that end their episode in a terminal state, and give no step, because their next state
            is not known.
        began: time of the first step; None without a column of times.
        notes: sentences on the order of the rows, concluded from the times and the names of episodes.
    """

    row: Ints
    q: Floats
    u: Floats
    q_next: Floats
    reward: Floats | None
    terminated: Bools
    truncated: Bools
    first: Bools
    episodes: tuple[int, ...]
    rejected: dict[int, str]
    ends: int
    interval: float | None
    notes: tuple[str, ...] = ()
    lost_ends: int = 0
    began: float | None = None

    def __len__(self) -> int:
        return len(self.row)

    @property
    def origin(self) -> str | None:
        """Text that distinguishes the log from others with the same numbers: the time of its first step; None without
        a column of times."""
        return None if self.began is None else f"begins at {self.began!r}"

    @property
    def digest(self) -> str:
        """Hash of the numbers. Equal transitions have equal hashes, even if they come from different files."""
        sha = hashlib.sha256()
        for array in (self.q, self.u, self.q_next, self.reward, self.terminated, self.truncated):
            sha.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()


def transitions_of(rows: Rows) -> Transitions:
    """Find the usable transitions of a log, and a reason for each row that can't be used.

    Raises:
        UnusableLog: the clock does not show which row follows which.
    """
    rejected = dict(rows.faults)
    episodes = episodes_of(rows)
    episode = episodes.number
    ticks = ticks_of(rows, episode, rejected)
    _reject(rejected, repeated(rows, episodes, rejected, coarse=ticks is not None))
    order = [row for row in np.argsort(episode, kind="stable").tolist() if rows.faults.get(row) or row not in rejected]
    out_of_order = _backwards(rows, episode, order, rejected, coarse=ticks is not None)
    _reject(rejected, out_of_order)
    # Rows that are out of order are skipped: the row before them is followed by the row after them.
    order = [row for row in order if row not in out_of_order]
    follower = {a: b for a, b in pairwise(order) if episode[a] == episode[b]}
    if rows.episode is not None:
        _reject(rejected, _going_on(rows, follower, rejected))
    interval = _interval(rows, follower, rejected) if ticks is None else ticks.interval
    paired = _paired(rows, follower, rejected, interval, ticks)
    usable = np.array([row for row in sorted(paired) if row not in rejected], dtype=np.int64)
    after = np.array([paired[row] for row in usable.tolist()], dtype=np.int64)
    begins = {first for first, row in _firsts(episode, order) if row}
    return Transitions(
        row=usable,
        q=rows.q[usable],
        u=rows.u[usable],
        q_next=rows.q[after] if rows.following is None else rows.following[usable],
        reward=None if rows.reward is None else rows.reward[usable],
        terminated=rows.terminated[usable],
        truncated=rows.truncated[usable],
        first=np.array([row in begins for row in usable.tolist()], dtype=np.bool_),
        episodes=tuple(np.unique(episode[order], return_counts=True)[1].tolist()),
        rejected=dict(sorted(rejected.items())),
        ends=len(rows) - len(usable) - len(rejected),
        interval=interval,
        lost_ends=int(rows.terminated.sum() - rows.terminated[usable].sum() - rows.terminated[list(rejected)].sum()),
        began=None if rows.time is None or not len(usable) else float(rows.time[usable[0]]),
        notes=(*episodes.notes, *([] if ticks is None else [f"{rows.roles.time}: {ticks.note}"])),
    )


def _reject(rejected: dict[int, str], reasons: dict[int, str]) -> None:
    for row, reason in reasons.items():
        rejected.setdefault(row, reason)


def _backwards(
    rows: Rows, episode: Ints, order: Iterable[int], rejected: dict[int, str], *, coarse: bool
) -> dict[int, str]:
    """Return a reason for each row whose time is not later than that of the row before in its episode, by the row's
    index. With a ``coarse`` clock, equal times are allowed."""
    if rows.time is None:
        return {}
    latest: dict[int, int] = {}
    reasons = {}
    for row in order:
        if not np.isfinite(rows.time[row]):
            continue
        before = latest.get(int(episode[row]))
        time = rows.time[row]
        if before is None or time > rows.time[before] or (coarse and time == rows.time[before]):
            if row not in rejected:
                latest[int(episode[row])] = row
        elif row not in rejected:
            reasons[row] = (
                f"{rows.roles.time}: expected a time after {rows.time[before]:g}, that of line {rows.lines[before]}, "
                f"got {time:g}"
            )
    return reasons


def _going_on(rows: Rows, follower: dict[int, int], rejected: dict[int, str]) -> dict[int, str]:
    """Return a reason, by the row's index, for each row that is marked as terminated although a row of the same episode
    follows. ``follower`` has the index of the row that follows each row."""
    return {
        row: f"{rows.roles.terminated}: expected 0, as line {rows.lines[after]} continues the episode, got 1"
        for row, after in follower.items()
        if rows.terminated[row] and row not in rejected
    }


def _interval(rows: Rows, follower: dict[int, int], rejected: dict[int, str]) -> float | None:
    """Return the median time between a row and the row that follows it; None without a column of times."""
    if rows.time is None or not follower:
        return None
    pairs = [(a, b) for a, b in follower.items() if a not in rejected and b not in rejected]
    steps = [float(rows.time[b] - rows.time[a]) for a, b in pairs]
    return float(np.median(steps)) if steps else None


def _paired(
    rows: Rows, follower: dict[int, int], rejected: dict[int, str], interval: float | None, ticks: Ticks | None
) -> dict[int, int]:
    """Return, for each row that has a next state, the index of the row that contains this next state.

    If the log has columns of next states, it is the row itself, otherwise the row that follows at the usual interval.
    """
    if rows.following is not None:
        return {row: row for row in range(len(rows)) if row not in rejected}
    paired = {}
    for row, after in follower.items():
        if not rows.sound[after] or rows.terminated[row] or rows.truncated[row]:
            continue
        if interval and rows.time is not None:
            step = rows.time[after] - rows.time[row]
            if ticks is None:
                usual = abs(step - interval) <= ONE_INTERVAL * interval
            else:
                usual = step <= GAP * ticks.tick and not (ticks.irregular[row] or ticks.irregular[after])
            if not usual:
                continue
        paired[row] = after
    return paired


def _firsts(episode: Ints, order: list[int]) -> Iterable[tuple[int, bool]]:
    """Yield each row in the given order, and whether it is the first of its episode."""
    earlier: set[int] = set()
    for row in order:
        number = int(episode[row])
        yield row, number not in earlier
        earlier.add(number)
