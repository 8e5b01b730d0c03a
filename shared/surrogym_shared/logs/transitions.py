"""Convert rows of a log to transitions (steps): find the row with each row's next state, and rows that contradict
others.

The episodes, repeated rows and clock of a log say which row is the next state of which. A row repeats another one only
by evidence of its place: the same time in the same episode, or a whole file that was joined to itself. Equal numbers
alone are no evidence, because a plant at rest writes equal rows.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from surrogym_shared.logs.rows import Rows
from surrogym_shared.logs.table import Bools, Floats, Ints, Table, UnusableLog
from surrogym_shared.words import counted, has

# If more than this share of a log's rows have the same time as the row before, the clock's resolution may be coarser
# than the time between two rows.
SHARED = 0.1
# Some rows have the same time as the row before. The share of these rows that differ from the row before in other
# columns decides: up to REPEATS, they are repeats of a row; from DIFFER on, they are steps under a coarse clock; in
# between, the log is refused.
REPEATS, DIFFER = 0.02, 0.2
# A log with a coarse clock (several rows of the same time) is refused if the number of rows differs by more than 1 from
# the usual number at more than this share of the times.
IRREGULAR = 0.1
GAP = 1.5  # if two successive times are more than this many ticks of the clock apart, rows are missing between them


@dataclass(frozen=True)
class Episodes:
    """Division of the n rows of a log into episodes.

    Attributes:
        number: number of each row's episode, (n,).
        overlapping: numbers of the episodes whose first time lies within the previous episode. This happens if a log
            was joined from files that share some rows.
        notes: sentences about episodes that begin without a mark or a new name, such as where the time goes back.
    """

    number: Ints
    overlapping: frozenset[int]
    notes: tuple[str, ...]


def episodes_of(rows: Rows) -> Episodes:
    """Number the episodes of a log.

    If the log has a column of episode names, an episode begins at each new name. It also begins where an earlier name
    returns, unless the log has times, or the rows of several episodes alternate. If the log has no such column, an
    episode begins after each row that ends one. In both cases, an episode also begins where the time goes back.
    """
    notes: list[str] = []
    label = np.zeros(len(rows), dtype=np.int64) if rows.episode is None else _names(rows, rows.episode, notes)
    order = np.argsort(label, kind="stable")
    begins = np.zeros(len(rows), dtype=np.bool_)
    begins[1:] = label[order][1:] != label[order][:-1]
    if rows.episode is None:
        begins[1:] |= (rows.terminated | rows.truncated)[order][:-1]
    overlapping: set[int] = set()
    if rows.time is not None:
        time = rows.time[order]
        restarts = _restarts(time) & ~begins
        if restarts.any():
            line = rows.lines[order[restarts.argmax()]]
            notes.append(
                f"{rows.roles.time}: goes back {counted(int(restarts.sum()), 'time')}, first in line {line}; a new "
                "episode begins there"
            )
        begins |= restarts
        overlapping = _overlapping(time, np.cumsum(begins), np.flatnonzero(restarts))
    number = np.empty(len(rows), dtype=np.int64)
    number[order] = np.cumsum(begins)
    return Episodes(number, frozenset(overlapping), tuple(notes))


def _names(rows: Rows, names: Ints, notes: list[str]) -> Ints:
    """Return the number of each row's episode (n,), by its name.

    A name that returns after other names gets a new number, unless the log has times, or the rows of several episodes
    alternate.
    """
    changes = np.zeros(len(rows), dtype=np.bool_)
    changes[1:] = names[1:] != names[:-1]
    stretch = np.cumsum(changes, dtype=np.int64)
    alternate = bool(np.median(np.bincount(stretch)) < 2) if len(rows) else False
    returned = int(stretch[-1]) + 1 - len(np.unique(names)) if len(rows) else 0
    # Names are kept if no name returns later, or if rows of several episodes alternate. If the log has times, they show
    # where another episode of the same name begins.
    if rows.time is not None or alternate or not returned:
        return names
    first: dict[int, int] = {}
    back = next(
        r for r in np.flatnonzero(changes) if first.setdefault(int(names[r]), int(r)) != r or names[r] == names[0]
    )
    notes.append(
        f"{rows.roles.episode}: {counted(returned, 'name')} returned after other episodes, first in line "
        f"{rows.lines[back]}; what follows is another episode"
    )
    return stretch.astype(np.int64)


def _restarts(time: Floats) -> Bools:
    """Return a mask (n,) of the rows at which the time goes back and then continues from the earlier time. A single row
    that is out of order does not count."""
    restarts = np.zeros(len(time), dtype=np.bool_)
    if len(time) > 2:
        restarts[1:-1] = (time[1:-1] < time[:-2]) & (time[2:] > time[1:-1]) & (time[2:] <= time[:-2])
    return restarts


def _overlapping(time: Floats, number: Ints, restarts: Ints) -> set[int]:
    """Return the numbers of the episodes that begin at a row in ``restarts``, at a later time than the beginning of the
    previous episode."""
    start = {int(number[row]): time[row] for row in range(len(time) - 1, -1, -1)}
    return {int(number[row]) for row in restarts if time[row] > start[int(number[row]) - 1]}


def repeated(rows: Rows, episodes: Episodes, faults: Mapping[int, str], *, coarse: bool) -> dict[int, str]:
    """Return a reason for each row that repeats an earlier one, by the row's index.

    A row repeats another one if all numbers are equal at the same time of the same episode, or if it belongs to a
    second copy of the whole log.

    Args:
        rows: rows of the log.
        episodes: division of the rows into episodes.
        faults: reasons of the rows that are already rejected, by the row's index.
        coarse: whether several rows may have the same time; then only copies of the whole log are found.
    """
    if rows.time is None and rows.episode is None:
        return {}
    whole = _content(rows)
    if copy := _copied(whole, episodes.number):
        return {row: f"repeats line {rows.lines[row % copy]}" for row in range(copy, len(rows))}
    if rows.time is None or coarse:
        return {}
    first_rows: dict[tuple[int, bytes], int] = {}
    reasons = {}
    for row in range(len(rows)):
        if row in faults:
            continue
        number, key = int(episodes.number[row]), whole[row].tobytes()
        before = first_rows.setdefault((number, key), row)
        if before == row and number in episodes.overlapping:
            before = first_rows.get((number - 1, key), row)
        if before != row:
            reasons[row] = f"repeats line {rows.lines[before]}"
    return reasons


def _content(rows: Rows) -> Floats:
    """Return the rows as one matrix (n, k) of all their numbers."""
    parts: list[Floats | Ints | Bools | None] = [
        rows.q, rows.u, rows.following, rows.reward, rows.time, rows.episode, rows.terminated, rows.truncated
    ]  # fmt: skip
    columns = [part.reshape(len(rows), -1).astype(np.float64) for part in parts if part is not None]
    return np.ascontiguousarray(np.concatenate(columns, 1))


def _copied(whole: Floats, number: Ints) -> int:
    """Return the number of rows after which the numbers ``whole`` (n, k) repeat from the start; 0 if they don't."""
    begins = np.flatnonzero(number[1:] != number[:-1]) + 1
    for start in begins[np.array([len(whole) % b == 0 for b in begins.tolist()], dtype=np.bool_)].tolist():
        if np.array_equal(whole[start], whole[0]) and np.array_equal(whole[start:], whole[:-start], equal_nan=True):
            return int(start)
    return 0


@dataclass(frozen=True)
class Ticks:
    """A clock that is coarser than the rows: several rows have the same time.

    Attributes:
        tick: median time between two successive values of the clock.
        interval: mean time between two rows.
        irregular: mask (n,) of the rows at times that have an unusual number of rows, so that rows may be missing.
    """

    tick: float
    interval: float
    irregular: Bools

    @property
    def note(self) -> str:
        words = f"several rows have the same time, which grows by {self.tick:g}: they follow each other in their order"
        rows = f"; {counted(int(self.irregular.sum()), 'row')} at times with another number of rows give no step"
        return words + (rows if self.irregular.any() else "")


def ticks_of(rows: Rows, episode: Ints, left_out: Mapping[int, str]) -> Ticks | None:
    """Return the ticks of a log's clock if the clock is coarser than the rows; otherwise None. ``episode`` (n,) has the
    number of each row's episode. Rows whose indices are in ``left_out`` are ignored.

    Raises:
        UnusableLog: it is unclear whether rows of the same time are repeats or steps; or the clock is coarser than the
            rows, and the number of rows at the same time varies, so that rows may be missing anywhere.
    """
    if rows.time is None:
        return None
    usable = np.ones(len(rows), dtype=np.bool_)
    usable[list(left_out)] = False
    order = np.flatnonzero(usable & np.isfinite(rows.time))
    order = order[np.argsort(episode[order], kind="stable")]
    time, number = rows.time[order], episode[order]
    same = (time[1:] == time[:-1]) & (number[1:] == number[:-1])
    if not len(same) or same.mean() <= SHARED:
        return None
    whole = _content(rows)[order]
    differ = float((whole[1:] != whole[:-1]).any(1)[same].mean())
    if differ <= REPEATS:
        return None
    if differ < DIFFER:
        raise UnusableLog(
            f"{rows.roles.time}: expected times that grow from row to row, got {same.mean():.0%} of the rows with the "
            f"time of the row before. {differ:.0%} of these differ from the row before in other columns, so it is "
            "unclear whether such rows are repeats or steps of their own: give finer times, leave out the column with "
            "a mapping file (--map), or remove the repeats"
        )
    begins = np.concatenate([[True], ~same])
    moment = np.cumsum(begins) - 1
    at, of, size = time[begins], number[begins], np.bincount(moment)
    # Mask of the times that are neither the first nor the last of an episode. At a first or last time, rows may be
    # missing.
    inner = np.zeros(len(size), dtype=np.bool_)
    inner[1:-1] = (of[1:-1] == of[:-2]) & (of[1:-1] == of[2:])
    within = of[1:] == of[:-1]
    if not within.any():
        return None
    tick = float(np.median(np.diff(at)[within]))
    usual = float(np.median(size[inner])) if inner.any() else float(size.max())
    odd = (np.abs(size - usual) > 1) & (inner | (size > usual))
    if odd.mean() > IRREGULAR:
        raise UnusableLog(
            f"{rows.roles.time}: expected times that grow from row to row, or the same number of rows at each time, "
            f"got {size[inner].min()} to {size[inner].max()} rows at one time: rows may be missing; give finer times, "
            "or leave out the column with a mapping file (--map) if no row is missing"
        )
    irregular = np.zeros(len(rows), dtype=np.bool_)
    irregular[order] = odd[moment]
    return Ticks(tick, tick / float(size[inner].mean() if inner.any() else usual), irregular)


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
    """Return the median time between a row and the row that follows it, in the unit of the column of times; None
    without such a column."""
    if rows.time is None or not follower:
        return None
    pairs = [(a, b) for a, b in follower.items() if a not in rejected and b not in rejected]
    steps = [float(rows.time[b] - rows.time[a]) for a, b in pairs]
    return float(np.median(steps)) if steps else None


def _paired(
    rows: Rows, follower: dict[int, int], rejected: dict[int, str], interval: float | None, ticks: Ticks | None
) -> dict[int, int]:
    """Return, for each row that has a next state, the index of the row that contains this next state.

    If the log has columns of next states, it is the row itself. Otherwise it is the row that follows, unless the time
    between the two rows shows that rows are missing.
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


DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d+,\d+\s*$")


class TooFewSteps(UnusableLog):
    """A log has too few usable steps. ``table`` is the log, and ``steps.rejected`` has the reason of each unusable
    row."""

    def __init__(self, message: str, table: Table, steps: Transitions) -> None:
        super().__init__(message)
        self.table = table
        self.steps = steps

    def __reduce__(self) -> tuple[type[TooFewSteps], tuple[str, Table, Transitions]]:
        return type(self), (str(self), self.table, self.steps)


def require_steps(table: Table, steps: Transitions, least: int) -> None:
    """Raise ``TooFewSteps`` with the most frequent reason if the log has fewer than ``least`` usable steps."""
    if len(steps) >= least:
        return
    minimum = "two usable steps" if least == 2 else "one usable step"
    parts = [f"expected {minimum} at least, got {len(steps)} of {counted(len(table), 'row')}"]
    if steps.ends:
        parts.append(
            f"{has(steps.ends, 'row')} no next state, because an episode or the log ends there, or a gap follows"
        )
    if steps.rejected:
        kinds = {row: _kind(reason) for row, reason in steps.rejected.items()}
        kind, count = Counter(kinds.values()).most_common(1)[0]
        row = next(row for row in kinds if kinds[row] == kind)
        parts.append(
            f"{counted(len(steps.rejected), 'row')} can't be used, {count} of them for the same reason, first in line "
            f"{table.lines[row]}: {steps.rejected[row]}"
        )
    if table.faults:
        parts.append(f"the columns are separated by {table.delimiter!r}: numbers need a decimal point, not a comma")
    elif any(DECIMAL_COMMA.match(cell) for row in steps.rejected for cell in table.row(row)):
        parts.append(
            f"the columns are separated by {table.delimiter!r}, and the numbers have a decimal comma: write a point"
        )
    raise TooFewSteps("; ".join(parts), table, steps)


def _kind(reason: str) -> str:
    """Return the reason of a rejected row without value and line number, so that faults of the same kind are equal."""
    return re.sub(r"line \d+", "line", reason.partition(", got")[0])
