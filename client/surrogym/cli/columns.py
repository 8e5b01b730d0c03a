"""Tables as text that fits the terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from textwrap import wrap

ENDLESS = 10_000  # number of characters in a line if the output does not go to a terminal, so that no line is broken
GAP = "  "


def columns(rows: Sequence[Sequence[object]], width: int | None = None) -> str:
    """Format rows as aligned columns. The first row is the heading.

    If the columns are too wide, headings are broken between words, and then cells too. If that is not enough, each row
    becomes several lines, each with a heading and a value.

    Args:
        rows: the heading and the rows.
        width: characters in a line; None takes the width of the terminal, or no limit if standard output is not a
            terminal.
    """
    heading, *body = [[_cell(value) for value in row] for row in rows]
    width = width or screen_width()
    if widths := _widths(heading, body, width - len(GAP) * (len(heading) - 1)):
        lines = [*_broken(heading, widths, bottom=True), *(line for row in body for line in _broken(row, widths))]
        return "\n".join(lines)
    return "\n\n".join("\n".join(_records(heading, row)) for row in body)


def screen_width() -> int:
    """Return the number of characters in a line of standard output; ``ENDLESS`` if it is not a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else ENDLESS


def _widths(heading: Sequence[str], body: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """Return widths of a table's columns that fit into ``room`` characters together; None if words would be broken.

    If possible, nothing is broken. Otherwise headings are broken between words. If that is not enough, cells are broken
    between words too, those of the widest columns first.
    """
    cells = [list(column) for column in zip(*body, strict=True)] or [[] for _ in heading]
    values = [max(map(len, column), default=0) for column in cells]
    words = [max(map(_longest_word, (name, *column))) for name, column in zip(heading, cells, strict=True)]
    if sum(words) > room:
        return None
    whole = [max(value, len(name)) for value, name in zip(values, heading, strict=True)]
    caps = range(max(values, default=0), -1, -1)
    even = ([max(word, min(value, cap)) for word, value in zip(words, values, strict=True)] for cap in caps)
    return next(widths for widths in (whole, *even) if sum(widths) <= room)


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def _broken(row: Sequence[str], widths: Sequence[int], *, bottom: bool = False) -> Iterator[str]:
    """Yield the lines of a table's row. Each cell is broken between words into lines of its column's width. Cells with
    fewer lines than others are aligned to the top, or with ``bottom`` to the bottom.
    """
    cells = [wrap(text, width, break_on_hyphens=False) or [""] for text, width in zip(row, widths, strict=True)]
    height = max(map(len, cells))
    for i in range(height):
        line = []
        for lines, width in zip(cells, widths, strict=True):
            place = i - (height - len(lines)) if bottom else i
            line.append((lines[place] if 0 <= place < len(lines) else "").ljust(width))
        yield GAP.join(line).rstrip()


def _records(heading: Sequence[str], row: Sequence[str]) -> Iterator[str]:
    longest = max(map(len, heading))
    return (f"{name.ljust(longest)}{GAP}{value}" for name, value in zip(heading, row, strict=True))


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
