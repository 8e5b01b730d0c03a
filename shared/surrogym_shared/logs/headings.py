"""Split the heading of a column into its name, the words of the name, and its unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

UNIT = re.compile(
    r"""^(?P<name>.*?\S)\s*(?:
        \[(?P<square>(?!\d+\])[^\[\]]*)\]      # such as time [s], but not action[0]
        | \((?P<round>(?!\d+\))[^()]*)\)       # such as time (s)
        | \s/\s*(?P<slash>[^\s/]+)             # such as T / K
        | \sin\s(?P<words>\S+)                 # such as time in s
    )$""",
    re.VERBOSE,
)
WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[^\W\d_A-Z]+|\d+")
NO_UNIT = ("", "-", "--", "1")
TIMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("d", "day", "days"), "d"),
}


@dataclass(frozen=True)
class Heading:
    """Heading of a column, such as ``T [K]``.

    Attributes:
        column: the whole heading.
        name: heading without the unit, such as ``T``.
        unit: unit, such as ``K``; empty if the heading has none.
        words: words of the name in lower case, such as ``("step", "reward")`` for ``stepReward``; single letters keep
            their case, because t is a time and T a temperature.
    """

    column: str
    name: str
    unit: str
    words: tuple[str, ...]

    @property
    def plain(self) -> str:
        """Words of the name, joined by ``_``."""
        return "_".join(self.words)


def heading(column: str) -> Heading:
    """Split the heading of a column into name, words and unit."""
    match = UNIT.match(column)
    name, unit = column, ""
    if match is not None:
        name = match["name"]
        unit = next(group for group in match.groups()[1:] if group is not None).strip()
    words = tuple(word if len(word) == 1 else word.lower() for word in WORDS.findall(name))
    return Heading(column, name, "" if unit in NO_UNIT else unit, words)


def timed(one: Heading) -> Heading:
    """Return a heading whose name ends with a unit of time, as ``time_s`` and ``timestampMs`` do, with this word as its
    unit. Return other headings unchanged."""
    if one.unit or len(one.words) < 2 or one.words[-1].lower() not in TIMES:
        return one
    return Heading(one.column, one.name, one.words[-1], one.words[:-1])
