"""Words of messages for people: numbers with their nouns, lists of names, and text without control characters."""

from __future__ import annotations

from collections.abc import Iterable

SHOWN = 10  # a message shows at most this many names of a list


# Codes of control characters; those of the last two ranges change the direction of text.
_HIDDEN = (
    *range(32),
    *range(127, 160),
    *range(0x202A, 0x202F),
    *range(0x2066, 0x206A),
)
_CONTROLS = {code: f"\\x{code:02x}" for code in _HIDDEN if chr(code) not in "\n\t"}


def visible(text: str) -> str:
    """Replace control characters by escapes, so that names and errors from others can't control the terminal."""
    return text.translate(_CONTROLS)


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as 1 row and 2,000 rows."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def has(count: int, noun: str) -> str:
    """Return a number with its noun and the verb "have", such as "1 row has" and "2 rows have"."""
    return f"{counted(count, noun)} {'has' if count == 1 else 'have'}"


def listed(names: Iterable[object]) -> str:
    """Return names as the text of a list: all names, or the first ten and the number of the others."""
    every = [str(name) if len(str(name)) <= 60 else f"{str(name)[:60]}..." for name in names]
    return str(every) if len(every) <= SHOWN else f"{str(every[:SHOWN])[:-1]} and {len(every) - SHOWN:,} more]"
