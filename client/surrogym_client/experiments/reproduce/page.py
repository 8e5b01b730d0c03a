"""The tables of rows inside a page of the documentation, between two marks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from surrogym_client.errors import SurrogymClientError
from surrogym_client.experiments.reproduce.rows import Row
from surrogym_client.experiments.reproduce.table import report, tasks_with_results

BEGIN, END = "<!-- efficiency: begin -->\n", "<!-- efficiency: end -->"


class NoSuchPlace(SurrogymClientError):
    """A page lacks the marks between which the tables belong."""


def update(page: Path, rows: Sequence[Row], pictures: Path) -> None:
    """Put the tables of rows into a page, and their pictures into a folder.

    Raises:
        NoSuchPlace: the page lacks the marks.
    """
    from surrogym_client.experiments.reproduce.pictures import draw_tasks

    before, _, after = _split(page)
    draw_tasks(pictures, rows)
    folder = os.path.relpath(pictures, page.parent)
    page.write_text(f"{before}{section(rows, folder)}{after}", encoding="utf-8")


def section(rows: Sequence[Row], folder: str) -> str:
    """What belongs between the marks; ``folder`` of the pictures is seen from the page."""
    links = "".join(f"![{task}]({folder}/efficiency-{task}.png)\n" for task in tasks_with_results(rows))
    return f"\n{report(rows)}\n{links}" if rows else ""


def present_section(page: Path) -> str:
    """What stands between the marks. Raises ``NoSuchPlace``."""
    return _split(page)[1]


def _split(page: Path) -> tuple[str, str, str]:
    head, found, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    between, closed, tail = rest.partition(END)
    if not found or not closed:
        raise NoSuchPlace(f"{page}: expected the lines {BEGIN.strip()} and {END}")
    return f"{head}{found}", between, f"{closed}{tail}"
