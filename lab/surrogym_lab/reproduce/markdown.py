"""Markdown of tables."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from textwrap import fill

from surrogym.cli.columns import ENDLESS, columns, screen_width


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first line is the heading."""
    rows = [lines[0], ["---"] * len(lines[0]), *lines[1:]]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def fitted(markdown: str, width: int | None = None) -> str:
    """Format Markdown for a terminal: tables by ``columns``, prose in lines of ``width`` characters.

    Without ``width``, lines have the width of the terminal. If standard output is not a terminal then, the text is
    returned unchanged.
    """
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
