"""Numbers with their nouns, for people."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as 1 row and 2,000 rows."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def has(count: int, noun: str) -> str:
    """Return a number with its noun and verb: 1 row has, 2 rows have."""
    return f"{counted(count, noun)} {'has' if count == 1 else 'have'}"
