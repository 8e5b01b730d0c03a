"""Find out what the cells of a column are: numbers of rows, times of a clock, numbers of episodes, or 0/1 marks."""

from __future__ import annotations

from typing import Literal

import numpy as np

from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.table import DATES, DURATIONS, Cells, Floats, flags, groups, numbers, stamps, times

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
