"""Conversion of a file's arrays to the columns of a log, with one row per step. Other arrays are ignored, and the
reason is kept."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_shared.logs.columns import ACTION, SINGLE, STATE
from surrogym_shared.logs.table import Cells, Table, UnusableLog
from surrogym_shared.logs.text import MOST_COLUMNS, is_unnamed, require_sizes

STATES = ("coordinates", "observations", "observation", "states", "state", "obs", "q")
ACTIONS = ("actions", "action", "acts", "u")
NEXT = ("next_coordinates", "next_observations", "next_observation", "next_states", "next_state", "next_obs", "next_q")


def table_of_arrays(path: Path, arrays: dict[str, Any], names: Sequence[str] = ()) -> Table:
    """Return the table of a log from a file's arrays: arrays (n,) with one value for each of n
    steps, and arrays (n, k) with k coordinates, next coordinates or action entries.

    Args:
        path: the file, for messages.
        arrays: the arrays by name.
        names: names of the coordinates; the default is ``s0``, ``s1``, ...

    Raises:
        UnusableLog: states, actions or next states are not (n, k), a reward or the like is not one value per step,
            columns differ in their length, two arrays have the same columns, or the names don't fit the states.
    """
    for name, array in arrays.items():
        if name in (*STATES, *ACTIONS, *NEXT) and array.ndim > 2:
            raise UnusableLog(
                f"expected shape (steps, entries) for the array {name} in {path}, got {array.shape}: give one row "
                "for each step, and the number of its episode in a further array called episode"
            )
    _require_names(path, arrays, names)
    ignored = {name: _shape(array) for name, array in arrays.items() if array.ndim not in (1, 2)}
    columns = {name: _columns(name, array, names) for name, array in arrays.items() if name not in ignored}
    if not columns:
        raise UnusableLog(
            f"expected arrays with one row for each step in {path}, got {ignored or 'none'}: save arrays called "
            "states, actions and rewards"
        )
    rows = _rows(columns)
    marked = any(name in STATES or STATE.match(name) for name in columns)
    for name in list(columns):
        array, spare = arrays[name], marked and not _has_role(name)
        if len(array) != rows and (array.size == 1 or spare):
            ignored[name] = _shape(array)
            del columns[name]
    flat = _flat(path, columns)
    lengths = {name: len(arrays[name]) for name in columns}
    if len(set(lengths.values())) > 1:
        raise UnusableLog(
            f"expected arrays with the same number of rows in {path}, got {lengths}: cut them to the same steps"
        )
    return Table(flat, np.arange(1, 1 + rows), unnamed=tuple(filter(is_unnamed, flat)), ignored=ignored)


def require_shapes(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ``UnusableLog`` if a file has too many arrays or too large ones, before any of them is read."""
    if len(shapes) > MOST_COLUMNS:
        raise UnusableLog(
            f"expected at most {MOST_COLUMNS:,} arrays in {path}, got {len(shapes):,}: save only the arrays of the log"
        )
    require_sizes(
        path, max((shape[0] for shape in shapes.values() if shape), default=0), sum(map(prod, shapes.values()))
    )


def _require_names(path: Path, arrays: Mapping[str, Cells], names: Sequence[str]) -> None:
    """Raise ``UnusableLog`` unless the given names of coordinates are different, and as many as the columns of each
    array of states."""
    if len(set(names)) < len(names):
        raise UnusableLog(f"expected different names in coordinate_names of {path}, got {list(names)}: rename some")
    for name, array in arrays.items():
        if names and name in (*STATES, *NEXT) and array.ndim == 2 and array.shape[1] != len(names):
            raise UnusableLog(
                f"expected {array.shape[1]} names in coordinate_names of {path}, one for each column of {name}, got "
                f"{list(names)}: correct coordinate_names"
            )


def _flat(path: Path, columns: Mapping[str, dict[str, Cells]]) -> dict[str, Cells]:
    """Return the columns of all arrays by name. Raises ``UnusableLog`` if two arrays have the same column."""
    flat: dict[str, Cells] = {}
    source: dict[str, str] = {}
    for array, found in columns.items():
        for column, cells in found.items():
            if column in flat:
                raise UnusableLog(
                    f"expected one array for the column {column!r} in {path}, got two, {source[column]} and "
                    f"{array}: remove one of them"
                )
            flat[column], source[column] = cells, array
    return flat


def _columns(name: str, array: Cells, names: Sequence[str]) -> dict[str, Cells]:
    """Return an array's columns by name: an array (n,) is one column, an array (n, k) is k columns, which are named
    ``q.s0`` or ``q.<name>``, ``action.0``, ``next.s0``."""
    if array.ndim == 1:
        return {name: array}
    count = array.shape[1]
    if name in ACTIONS:
        return {f"action.{i}": array[:, i] for i in range(count)}
    if name in (*STATES, *NEXT):
        own = names if len(names) == count else [f"s{i}" for i in range(count)]
        return {f"{'q' if name in STATES else 'next'}.{one}": array[:, i] for i, one in enumerate(own)}
    if _is_single(name):
        if count != 1:
            raise UnusableLog(
                f"expected one value for each step in {name}, got an array of shape {array.shape}: save it as (steps,)"
            )
        return {name: array[:, 0]}
    return {f"{name}.{i}": array[:, i] for i in range(count)}


def _rows(columns: dict[str, dict[str, Cells]]) -> int:
    """Return the number of rows of the log. It is the length of the array of actions; without such an array, it is the
    length that most arrays have."""
    lengths = {name: len(next(iter(found.values()), ())) for name, found in columns.items()}
    known = [length for name, length in lengths.items() if name in ACTIONS or ACTION.match(name)]
    return known[0] if known else Counter(lengths.values()).most_common(1)[0][0]


def _has_role(name: str) -> bool:
    known = name in (*STATES, *ACTIONS, *NEXT) or ACTION.match(name) or STATE.match(name)
    return bool(known or _is_single(name) or name.startswith("next"))


def _is_single(name: str) -> bool:
    return any(name.lower() in known for known in SINGLE.values())


def _shape(array: Cells) -> str:
    return f"its shape {array.shape} is not one value a step"
