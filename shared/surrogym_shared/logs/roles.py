"""Find out which column of a table has which role: state, action, reward and so on. A mapping declares the roles;
without one, the names of the columns and the contents of their cells decide."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from surrogym_shared.logs.columns import (
    STATE,
    LogMapping,
    Roles,
    mapping_of,
    roles_by_mapping,
    roles_by_name,
)
from surrogym_shared.logs.counting import (
    Numbering,
    episodes_by,
    grows,
    grows_always,
    is_in_blocks,
    is_mark,
    is_steady,
    is_unordered,
    numbering,
)
from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.headings import heading, timed
from surrogym_shared.logs.rlds import from_rlds
from surrogym_shared.logs.table import Cells, Table
from surrogym_shared.words import listed

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
