"""Rows as text that fits the terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from textwrap import fill, wrap

ENDLESS = 10_000  # characters in a line that ends at no terminal's edge
GAP = "  "


def columns(rows: Sequence[Sequence[object]], width: int | None = None) -> str:
    """Rows as aligned columns; the first row is the heading.

    Where they don't fit ``width`` characters, headings are broken between words, then cells as well; where that is not
    enough, each row becomes lines of heading and value. None is the width of the terminal that standard output is, if
    it is one.
    """
    heading, *body = [[_cell(value) for value in row] for row in rows]
    width = width or screen_width()
    if widths := _widths(heading, body, width - len(GAP) * (len(heading) - 1)):
        lines = [*_broken(heading, widths, bottom=True), *(line for row in body for line in _broken(row, widths))]
        return "\n".join(lines)
    return "\n\n".join("\n".join(_records(heading, row)) for row in body)


def fitted(markdown: str, width: int | None = None) -> str:
    """Markdown for a terminal: its tables as ``columns``, its prose in lines of ``width``; elsewhere as it is."""
    width = width or screen_width()
    if width == ENDLESS:
        return markdown
    parts = []
    for first, lines in groupby(markdown.splitlines(), key=lambda line: line[:1] if line[:1] in "|" else "prose"):
        if first == "|":
            heading, _, *body = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
            parts.append(columns([heading, *body], width))
        elif first == "prose":
            parts.append(fill(" ".join(lines), width, break_on_hyphens=False))
        else:
            parts.extend(lines)
    return "\n".join(parts)


def screen_width() -> int:
    """Characters in a line of standard output; without end where it is no terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else ENDLESS


def _widths(heading: Sequence[str], body: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """The widest columns that fit: whole headings if they can be, then whole cells, then as even as words allow."""
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
    """The lines of a row whose cells are broken between words; short ones stand at the top, or the bottom."""
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
