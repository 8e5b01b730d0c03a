"""The tables of rows inside a page of the documentation, between pairs of marks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from surrogym_client.errors import SurrogymClientError
from surrogym_lab.reproduce.rows import Row
from surrogym_lab.reproduce.table import headline, report, tasks_with_results

PARTS = ("headline", "efficiency")


class NoSuchPlace(SurrogymClientError):
    """A page lacks the marks between which the tables belong."""


def update(page: Path, rows: Sequence[Row], pictures: Path) -> None:
    """Put the tables of rows between the marks that a page has, and their pictures into a folder.

    Raises:
        NoSuchPlace: the page has none of the pairs of marks.
    """
    from surrogym_lab.reproduce.pictures import draw_tasks

    text = page.read_text(encoding="utf-8")
    present = present_sections(page)
    draw_tasks(pictures, rows)
    folder = os.path.relpath(pictures, page.parent)
    for name, before in present.items():
        begin, end = marks(name)
        text = text.replace(f"{begin}{before}{end}", f"{begin}{section(name, rows, folder)}{end}")
    page.write_text(text, encoding="utf-8")


def section(name: str, rows: Sequence[Row], folder: str) -> str:
    """The content between the marks ``name``. ``folder`` of the pictures is relative to the page."""
    if not rows:
        return ""
    if name == "headline":
        return f"\n{headline(rows)}\n"
    links = "".join(f"![{task}]({folder}/efficiency-{task}.png)\n" for task in tasks_with_results(rows))
    return f"\n{report(rows)}\n{links}"


def present_sections(page: Path) -> dict[str, str]:
    """The present content between each pair of marks of a page, by name. Raises ``NoSuchPlace`` if there are none."""
    text, found = page.read_text(encoding="utf-8"), {}
    for name in PARTS:
        begin, end = marks(name)
        _, opened, rest = text.partition(begin)
        between, closed, _ = rest.partition(end)
        if opened and closed:
            found[name] = between
    if not found:
        raise NoSuchPlace(f"{page}: expected the lines {' and '.join(m.strip() for m in marks(PARTS[-1]))}")
    return found


def marks(name: str) -> tuple[str, str]:
    """The lines that begin and end the part ``name`` of a page."""
    return f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
