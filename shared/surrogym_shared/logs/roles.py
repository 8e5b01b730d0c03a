"""Find out which column of a table has which role: state, action, reward and so on. A mapping declares the roles;
without one, the names of the columns and the contents of their cells decide.

The cells of a column may be numbers of rows, times of a clock, numbers of episodes, or 0/1 marks. Steps of the format
RLDS (Reinforcement Learning Datasets) become rows that also have the next observation.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surrogym_shared.logs.columns import (
    NEXT,
    STATE,
    LogMapping,
    Roles,
    heading,
    mapping_of,
    roles_by_mapping,
    roles_by_name,
    timed,
)
from surrogym_shared.logs.table import (
    DATES,
    DURATIONS,
    Bools,
    Cells,
    Floats,
    Table,
    UnusableLog,
    flags,
    groups,
    numbers,
    stamps,
    times,
)
from surrogym_shared.words import has, listed

Numbering = Literal["rows", "episodes", "gaps"]

FEWEST = 4  # in a log with fewer rows, the meaning of a column is not inferred from its cells
MOST_TURNS = 0.5  # a column numbers episodes, or is a clock, if it changes or restarts in at most this share of rows
# A column grows steadily, as a clock, if its increments differ from their median by at most this share of the median.
EQUAL = 1e-6


def measured(cells: Cells) -> Floats | None:
    """Return a column of numbers or times as numbers (n,); None if a cell is neither, or with fewer than 4 cells."""
    try:
        values, faults = times("", cells)
    except UnusableLog:
        return None
    return None if faults or len(values) < FEWEST else values


def numbering(cells: Cells) -> Numbering | None:
    """Return what a column of whole numbers counts; None if it counts nothing.

    ``rows``: it numbers all rows. ``episodes``: it numbers the rows of each episode, and restarts with the next one.
    ``gaps``: it numbers rows in one of these two ways, but some numbers are missing.
    """
    values = measured(cells)
    if values is None or cells.dtype.kind in (DATES, DURATIONS) or (values != np.floor(values)).any():
        return None
    plain, faults = numbers("", cells)
    if faults or stamps(plain) is not None:  # dates such as 20240331 are whole numbers, but don't number rows
        return None
    change = np.diff(values)
    if (change == 1).all():
        return "rows"
    restarts = change != 1
    again = values[1:][restarts]
    if restarts.mean() <= MOST_TURNS and (change[restarts] <= 0).all() and (again == values[0]).all():
        return "episodes"
    return "gaps" if grows(cells) and (change != 0).all() and not is_unordered(cells) else None


def is_unordered(cells: Cells) -> bool:
    """Whether a column has a different whole number in each row, not in ascending order, as the index of shuffled rows
    has."""
    values = measured(cells)
    whole = values is not None and bool((values == np.floor(values)).all())
    return values is not None and whole and len(np.unique(values)) == len(values) and bool((np.diff(values) < 0).any())


def grows_always(cells: Cells) -> bool:
    """Whether a column is larger in each row than in the one before."""
    values = measured(cells)
    return values is not None and bool((np.diff(values) > 0).all())


def grows(cells: Cells) -> bool:
    """Whether a column grows, and falls only back to about its first value, as a time that restarts does."""
    values = measured(cells)
    if values is None:
        return False
    change = np.diff(values)
    if not (change > 0).any() or (change < 0).mean() > MOST_TURNS:
        return False
    began = values[0] + 1.5 * np.median(change[change > 0])
    return bool((values[1:][change < 0] <= began).all())


def is_steady(cells: Cells) -> bool:
    """Whether a column grows by the same amount in each row, whatever the actions are, as a clock does."""
    values = measured(cells)
    if values is None or len(values) < 2 * FEWEST:
        return False
    change = np.diff(values)
    step = float(np.median(change))
    return bool(step > 0 and (np.abs(change - step) <= EQUAL * max(step, np.abs(values).max() * 1e-9)).all())


def is_mark(cells: Cells) -> bool:
    """Whether all cells are 0 or 1, or true or false."""
    try:
        return not flags("", cells)[1]
    except UnusableLog:
        return False


def is_in_blocks(cells: Cells) -> bool:
    """Whether a column keeps a whole number or a text for several rows before it changes, as names of episodes do."""
    numbers = groups(cells)
    if len(numbers) < FEWEST or numbers[-1] == numbers[0]:
        return False
    values = measured(cells)
    whole = values is None or bool((values == np.floor(values)).all())
    return whole and bool((np.diff(numbers) != 0).mean() <= MOST_TURNS)


def episodes_by(name: str, cells: Cells) -> Cells:
    """Return the number of each row's episode (n,), from a column that marks first rows or restarts with each episode.

    Raises:
        UnusableLog: the column has neither marks nor numbers.
    """
    if is_mark(cells):
        return np.cumsum(flags(name, cells)[0])
    values = measured(cells)
    if values is None:
        raise UnusableLog(
            f"{name}: expected 1 in the first row of each episode and 0 in the others, or a number that restarts in "
            "each episode, got other cells: correct the column, or leave it out with a mapping file (--map)"
        )
    return np.cumsum(np.concatenate([[0], np.diff(values) <= 0]))


FIRST, LAST, TERMINAL = "is_first", "is_last", "is_terminal"


BY = "episodes by "  # prefix of the name of a column of episode numbers that was derived from another column
STARTS = ("is_first", "episode_start", "episode_starts")  # names of columns that mark the first step of each episode
INDEX = {"index", "step", "steps", "timestep", "row", "line"}  # words in the names of columns that number rows
# Whole names (not only words in names) of columns that number rows.
COUNTERS = {"sample", "frame", "tick", "counter", "count", "number", "no", "nr", "id", "i", "k", "n"}
COUNTED = "it grows by one in each row, as the number of a row does"
WITHIN = "it numbers the rows of each episode"
# A message proposes a mapping (which column has which role) only if it has at most this many characters.
LONGEST_HINT = 600

Shown = Callable[[Cells], bool]
# For each role of a column, such as reward: words in the column's name that make the role likely, whole names that do,
# and a test that the column's cells have to pass.
LIKELY: dict[str, tuple[set[str], set[str], Shown]] = {
    "reward": (
        {"reward", "rewards", "rew", "return", "returns"},
        {"cost", "costs", "score", "payoff", "penalty", "profit", "utility"},
        lambda _: True,
    ),
    "terminated": (
        {"done", "dones", "terminated", "terminal", "terminate", "ended", "failed", "failure", "crashed", "absorbing"},
        {"end", "is_end", "episode_end", "end_of_episode", "game_over", "episode_over", "finished", "is_last", "last"}
        | {"fail", "crash", "dead", "stopped"},
        is_mark,
    ),
    "truncated": ({"truncated", "truncation", "timeout", "timeouts"}, {"time_limit", "limit_reached"}, is_mark),
    "episode": (
        {"episode", "episodes", "traj", "trajectory", "rollout", "trial"},
        {"ep", "run_id", "run_number", "batch", "experiment"},
        is_in_blocks,
    ),
    "time": ({"time", "timestamp", "date", "datetime", "clock", "elapsed", "seconds", "millis", "utc"}, {"ms"}, grows),
    "action": ({"action", "actions"}, set(), lambda _: True),
    "next state": ({"next"}, set(), lambda _: True),
}


def read_roles(table: Table, mapping: Path | Mapping[str, Any] | LogMapping | None) -> tuple[Table, Roles]:
    """Return the roles of a table's columns, and the table with derived columns, such as numbers of episodes.

    Without a mapping, the names of the columns decide, and a column that numbers the rows is left out.

    Raises:
        OSError: the mapping file can't be read.
        UnusableLog: a role has no column or several, a column without a known name is likely a reward, an end, an
            episode or a time, or the mapping does not fit the log.
    """
    table = from_rlds(table)
    if mapping is None:
        table, roles = _by_name(table)
    else:
        where = str(mapping) if isinstance(mapping, Path) else "the mapping"
        mapped = mapping_of(mapping, where)
        if mapped.episode is not None and mapped.episode.removeprefix(BY) in table.columns:
            table = _with_episodes(table, mapped.episode.removeprefix(BY))
        roles = roles_by_mapping(mapped, (*table.names, *table.unnamed), where)
    if roles.discrete is None:
        roles = replace(roles, discrete=table.discrete, limits={**table.limits, **roles.limits})
    if twice := [name for name in roles.used if name in table.repeated]:
        count = table.repeated[twice[0]]
        raise UnusableLog(
            f"expected different names of the columns that are used, got {twice[0]!r} {count} times: rename the columns"
        )
    return table, roles


def _by_name(table: Table) -> tuple[Table, Roles]:
    roles = roles_by_name(table.names)
    starts = [name for name in table.columns if heading(name).plain in STARTS and is_mark(table.columns[name])]
    plain = [name for name in _plain(table, roles) if name not in starts]
    kinds = {name: kind for name in (*table.unnamed, *plain) if (kind := _numbering(name, table)) is not None}
    if plain and all(name in kinds for name in plain):
        raise UnusableLog(
            f"expected a column of the state besides {listed(plain)}, which only number the rows: name the columns in "
            "a mapping file (--map)"
        )
    roles = roles_by_name([name for name in table.names if name not in (*starts, *kinds)])
    _ask(table, roles, [name for name in plain if name not in kinds])
    ignored = {name: WITHIN if kind == "episodes" else COUNTED for name, kind in kinds.items()}
    ignored |= {name: "it has no name" for name in table.unnamed if name not in kinds}
    if roles.episode is None and (by := [*starts, *(name for name, kind in kinds.items() if kind == "episodes")]):
        table = _with_episodes(table, by[0])
        roles = replace(roles, episode=f"{BY}{by[0]}")
    if roles.time is None and (gaps := [name for name, kind in kinds.items() if kind == "gaps"]):
        roles = replace(roles, time=gaps[0])
        del ignored[gaps[0]]
    remarks = (
        [] if roles.time is not None else [name for name in _plain(table, roles) if grows_always(table.columns[name])]
    )
    words = (f"{name}: grows in each row; if it is the time, say so in a mapping file (--map)" for name in remarks)
    return replace(table, ignored={**table.ignored, **ignored}, remarks=(*table.remarks, *words)), roles


def _with_episodes(table: Table, name: str) -> Table:
    """Return the table with a new column of episode numbers, derived from the column ``name``: marks of first rows, or
    a counter that restarts."""
    return replace(table, columns={**table.columns, f"{BY}{name}": episodes_by(name, table.columns[name])})


def _plain(table: Table, roles: Roles) -> list[str]:
    """Return the names of columns that are states only because their names suggest no other role."""
    free = [column for name, column in roles.state.items() if name not in roles.following and column in table.columns]
    return [column for column in free if not STATE.match(heading(column).name)]


def _numbering(name: str, table: Table) -> Numbering | None:
    """Return what a column counts: rows of the log or of episodes; None if it counts nothing.

    A column that restarts or has gaps counts rows only if its name is one of a counter, such as ``step``.

    Raises:
        UnusableLog: the column numbers the rows, and the rows are not in the order of these numbers.
    """
    kind, one = numbering(table.columns[name]), heading(name)
    is_index = name in table.unnamed or bool(INDEX.intersection(one.words))
    if is_index and kind is None and is_unordered(table.columns[name]):
        raise UnusableLog(
            f"expected rows in the order of {name!r}, which numbers them, got another order: sort the log by it, or "
            "say what the columns are in a mapping file (--map)"
        )
    return kind if kind == "rows" or is_index or one.plain in COUNTERS else None


def _ask(table: Table, roles: Roles, plain: Sequence[str]) -> None:
    """Raise ``UnusableLog`` if columns are likely a reward, an end, an episode or a time, but have no such role."""
    ignored = [name for name in roles.ignored if name in table.columns]
    likely: dict[str, str] = {}
    for name in [*plain, *ignored]:
        role = _likely(name, table.columns[name], roles)
        if role is not None and (name in plain or getattr(roles, role, True) is None):
            likely[name] = role
    if roles.time is None and not likely:
        likely |= {name: "time" for name in plain if is_steady(table.columns[name])}
    if not likely:
        return
    words = ", ".join(f"{name!r} is likely the {role}" for name, role in likely.items())
    single: dict[str, Any] = {
        role: name for name, role in reversed(likely.items()) if getattr(roles, role, True) is None
    }
    state = {name: column for name, column in roles.state.items() if column not in likely}
    proposed = replace(roles, state=state, **single).mapping.model_dump(exclude_defaults=True)
    hint = json.dumps(proposed, ensure_ascii=False)
    example = f" such as {hint}" if len(hint) <= LONGEST_HINT and state else ""
    raise UnusableLog(
        f"expected known names of the columns for reward, end, episode and time, got unknown ones: {words}. Say what "
        f"each column is in a mapping file (--map map.json),{example} with the column among the states if it is a state"
    )


def _likely(name: str, cells: Cells, roles: Roles) -> str | None:
    one = timed(heading(name))
    for role, (words, names, has_cells_of) in LIKELY.items():
        by_name = one.plain in names and getattr(roles, role, True) is None
        if (by_name or words.intersection(one.words)) and has_cells_of(cells):
            return role
    return None


def from_rlds(table: Table) -> Table:
    """Convert a log in the format RLDS to rows with their next state and end; return any other log unchanged.

    A step of RLDS has an observation, the action taken there, and the reward for it. The last step of an episode
    (``is_last``) has only the observation. Its action and reward mean nothing, so it becomes no row. The row of the
    step before is terminated if the last step has ``is_terminal``, and truncated otherwise.

    Raises:
        UnusableLog: the columns ``is_first``, ``is_last`` and ``is_terminal`` contradict each other.

    References:
        S. Ramos et al., "RLDS: an Ecosystem to Generate, Share and Use Datasets in Reinforcement Learning", 2021.
    """
    marks = {heading(name).plain: name for name in table.columns if heading(name).plain in (FIRST, LAST, TERMINAL)}
    if FIRST not in marks or LAST not in marks or table.faults:
        return table
    first, last = _marks(table, marks[FIRST]), _marks(table, marks[LAST])
    terminal = _marks(table, marks[TERMINAL]) if TERMINAL in marks else np.zeros_like(last)
    after_last = np.concatenate([[True], last[:-1]])
    if (odd := np.flatnonzero(first != after_last)).size:
        raise UnusableLog(
            f"expected {FIRST} to be 1 in the first row and after each row with {LAST}, as RLDS defines them, got "
            f"{int(first[odd[0]])} in line {table.lines[odd[0]]}"
        )
    if (odd := np.flatnonzero(terminal & ~last)).size:
        raise UnusableLog(f"expected {TERMINAL} only where {LAST} is 1, got 1 and 0 in line {table.lines[odd[0]]}")
    rows = np.flatnonzero(~last[:-1])
    if not len(rows):
        raise UnusableLog(f"expected steps of RLDS, got none: each row is marked by {LAST}, or is the last row")
    columns = {name: cells for name, cells in table.columns.items() if name not in marks.values()}
    states = roles_by_name(list(columns)).state
    columns_of_steps = {name: cells[rows] for name, cells in columns.items()}
    if not any(NEXT.match(heading(name).name) for name in columns):
        columns_of_steps |= {f"next.{name}": columns[column][rows + 1] for name, column in states.items()}
    columns_of_steps |= {"terminated": terminal[rows + 1], "truncated": last[rows + 1] & ~terminal[rows + 1]}
    if "episode" not in columns_of_steps:
        columns_of_steps["episode"] = np.cumsum(first)[rows]
    without = len(table) - len(rows)
    return replace(
        table,
        columns=columns_of_steps,
        lines=table.lines[rows],
        cells=[table.cells[row] for row in rows.tolist()] if len(table.cells) else (),
        remarks=(*table.remarks, f"RLDS: {has(without, 'row')} only the last observation of an episode, and no step"),
    )


def _marks(table: Table, name: str) -> Bools:
    marks, faults = flags(name, table.columns[name])
    if faults:
        row = next(iter(faults))
        raise UnusableLog(f"line {table.lines[row]}: {faults[row]}")
    return marks
