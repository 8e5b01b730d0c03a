"""Which tests are left to ``make test-all``: those that ``tests/long.toml`` lists, with the reason."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

TESTS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Line:
    """A line of the list: a file or a function in it, and what the brackets of its cases hold."""

    written: str

    def names(self, node: str) -> bool:
        """Whether a test is meant, by its id below ``tests/``."""
        place, _, cases = self.written.partition("[")
        test, _, case = node.partition("[")
        return (test == place or test.startswith(f"{place}::")) and (
            not cases or re.search(cases[:-1], case[:-1]) is not None
        )


def lines(path: Path = TESTS / "long.toml") -> list[Line]:
    """All lines of the list."""
    groups = tomllib.loads(path.read_text(encoding="utf-8"))["left"]
    assert all(group["reason"] for group in groups)
    return [Line(test) for group in groups for test in group["tests"]]


def unknown(nodes: Iterable[str]) -> list[str]:
    """Lines that name none of these tests."""
    known = list(nodes)
    return [line.written for line in lines() if not any(line.names(node) for node in known)]
