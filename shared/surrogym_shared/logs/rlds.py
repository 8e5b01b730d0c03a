"""Convert steps of the format RLDS (Reinforcement Learning Datasets) to rows that also have the next observation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surrogym_shared.logs.columns import NEXT, roles_by_name
from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.headings import heading
from surrogym_shared.logs.table import Bools, Table, flags
from surrogym_shared.words import has

FIRST, LAST, TERMINAL = "is_first", "is_last", "is_terminal"


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
