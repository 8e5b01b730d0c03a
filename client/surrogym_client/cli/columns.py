"""Rows as text that fits the terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from textwrap import wrap

ENDLESS = 10_000  # characters in a line that ends at no terminal's edge
GAP = "  "


def columns(rows: Sequence[Sequence[object]], width: int | None = None) -> str:
    """Rows as aligned columns; the first row is the heading.

    Where they don't fit ``width`` characters, headings are broken between words; where that is not enough, each row
    becomes lines of heading and value. None is the width of the terminal that standard output is, if it is one.
    """
    heading, *body = [[_cell(value) for value in row] for row in rows]
    width = width or screen_width()
    values = [max((len(row[i]) for row in body), default=0) for i in range(len(heading))]
    for shortest in (len, _longest_word):
        widths = [max(value, shortest(name)) for value, name in zip(values, heading, strict=True)]
        if sum(widths) + len(GAP) * (len(widths) - 1) <= width:
            return "\n".join(_line(cells, widths) for cells in (*_broken(heading, widths), *body))
    return "\n\n".join("\n".join(_records(heading, row)) for row in body)


def screen_width() -> int:
    """Characters in a line of standard output; without end where it is no terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else ENDLESS


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def _broken(heading: Sequence[str], widths: Sequence[int]) -> Iterator[list[str]]:
    """The lines of a heading whose cells are broken between words; short ones stand at the bottom."""
    cells = [wrap(text, width, break_on_hyphens=False) for text, width in zip(heading, widths, strict=True)]
    height = max(map(len, cells))
    padded = [[""] * (height - len(lines)) + lines for lines in cells]
    return (list(line) for line in zip(*padded, strict=True))


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    return GAP.join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()


def _records(heading: Sequence[str], row: Sequence[str]) -> Iterator[str]:
    longest = max(map(len, heading))
    return (f"{name.ljust(longest)}{GAP}{value}" for name, value in zip(heading, row, strict=True))


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
