"""Arrays of a file to columns: one row a step each; what is no column is ignored with its reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_shared.logs.columns import ACTION, SINGLE, STATE
from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.sizes import MOST_COLUMNS, require_sizes
from surrogym_shared.logs.table import Cells, Table
from surrogym_shared.logs.text import is_unnamed

STATES = ("coordinates", "observations", "observation", "states", "state", "obs", "q")
ACTIONS = ("actions", "action", "acts", "u")
NEXT = ("next_coordinates", "next_observations", "next_observation", "next_states", "next_state", "next_obs", "next_q")


def table_of_arrays(path: Path, arrays: dict[str, Any], names: Sequence[str] = ()) -> Table:
    """The table of a file's arrays: (n,) each, or (n, k) of states, actions and next states.

    Args:
        path: of the file, for messages.
        arrays: by name.
        names: of the coordinates; without them they are called ``s0``, ``s1``, ...

    Raises:
        UnusableLog: states, actions or next states are not (n, k), a reward or the like is not one value a step,
            columns differ in their length, two arrays have the same columns, or the names don't fit the states.
    """
    for name, array in arrays.items():
        if name in (*STATES, *ACTIONS, *NEXT) and array.ndim > 2:
            raise UnusableLog(
                f"expected one row a step, got shape {array.shape} for {name} in {path}: give (steps, dims), and the "
                "episodes as an array of their own, such as episode"
            )
    _require_names(path, arrays, names)
    ignored = {name: _shape(array) for name, array in arrays.items() if array.ndim not in (1, 2)}
    columns = {name: _columns(name, array, names) for name, array in arrays.items() if name not in ignored}
    if not columns:
        raise UnusableLog(
            f"expected arrays of one row a step in {path}, got {ignored or 'none'}: name them states, actions "
            "and rewards"
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
            f"expected arrays of the same number of rows in {path}, got {lengths}: cut them to the same steps"
        )
    return Table(flat, np.arange(1, 1 + rows), unnamed=tuple(filter(is_unnamed, flat)), ignored=ignored)


def require_shapes(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse arrays that are too many or too large, before any of them is read. Raises ``UnusableLog``."""
    if len(shapes) > MOST_COLUMNS:
        raise UnusableLog(f"expected at most {MOST_COLUMNS:,} arrays in {path}, got {len(shapes):,}")
    require_sizes(
        path, max((shape[0] for shape in shapes.values() if shape), default=0), sum(map(prod, shapes.values()))
    )


def _require_names(path: Path, arrays: Mapping[str, Cells], names: Sequence[str]) -> None:
    """Raise ``UnusableLog`` unless the names of the coordinates are different, and as many as the states have."""
    if len(set(names)) < len(names):
        raise UnusableLog(f"expected different names in coordinate_names in {path}, got {list(names)}: rename some")
    for name, array in arrays.items():
        if names and name in (*STATES, *NEXT) and array.ndim == 2 and array.shape[1] != len(names):
            raise UnusableLog(
                f"expected {array.shape[1]} names in coordinate_names in {path}, one for each column of {name}, got "
                f"{list(names)}"
            )


def _flat(path: Path, columns: Mapping[str, dict[str, Cells]]) -> dict[str, Cells]:
    """Return the columns of all arrays by name. Raises ``UnusableLog`` if two arrays have the same column."""
    flat: dict[str, Cells] = {}
    source: dict[str, str] = {}
    for array, found in columns.items():
        for column, cells in found.items():
            if column in flat:
                raise UnusableLog(
                    f"expected one array for the column {column!r} in {path}, got two: {source[column]} and {array}"
                )
            flat[column], source[column] = cells, array
    return flat


def _columns(name: str, array: Cells, names: Sequence[str]) -> dict[str, Cells]:
    """An array (n,) as it is, one (n, k) as k columns: ``q.s0`` or ``q.<name>``, ``action.0``, ``next.s0``."""
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
            raise UnusableLog(f"expected one value a step for {name}, got an array of shape {array.shape}")
        return {name: array[:, 0]}
    return {f"{name}.{i}": array[:, i] for i in range(count)}


def _rows(columns: dict[str, dict[str, Cells]]) -> int:
    """Rows of the log: those of its actions, and without known ones the most frequent length."""
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
