"""A table inside a page of the documentation, between two marks."""

from __future__ import annotations

from pathlib import Path

from surrogym_client.errors import SurrogymClientError

BEGIN, END = "<!-- {}: begin -->", "<!-- {}: end -->"


class NoSuchPlace(SurrogymClientError):
    """A page lacks the marks between which a table belongs."""


def insert(page: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of ``name``.

    Raises:
        NoSuchPlace: the page lacks them.
    """
    before, _, after = _split(page, name)
    page.write_text(f"{before}{text}{after}", encoding="utf-8")


def inserted(page: Path, name: str) -> str:
    """What stands between the marks of ``name``. Raises ``NoSuchPlace``."""
    return _split(page, name)[1]


def _split(page: Path, name: str) -> tuple[str, str, str]:
    begin, end = BEGIN.format(name), END.format(name)
    head, found, rest = page.read_text(encoding="utf-8").partition(f"{begin}\n")
    between, closed, tail = rest.partition(end)
    if not found or not closed:
        raise NoSuchPlace(f"{page}: expected the lines {begin} and {end}")
    return f"{head}{found}", between, f"{closed}{tail}"
