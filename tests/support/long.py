"""Which tests are left to ``make test-all``: those that ``tests/long.toml`` lists, with the reason."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

TESTS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Line:
    """A line of the list: a file or a function in it, and an expression that is found in the brackets of its cases."""

    written: str

    @cached_property
    def place(self) -> str:
        return self.written.partition("[")[0]

    @cached_property
    def file(self) -> str:
        return self.place.partition("::")[0]

    @cached_property
    def cases(self) -> re.Pattern[str]:
        return re.compile(self.written.partition("[")[2][:-1])

    def names(self, node: str) -> bool:
        """Whether a test is meant, by its id below ``tests/``."""
        test, _, case = node.partition("[")
        return (test == self.place or test.startswith(f"{self.place}::")) and bool(self.cases.search(case[:-1]))


class Long:
    """The list."""

    def __init__(self, path: Path = TESTS / "long.toml") -> None:
        groups = tomllib.loads(path.read_text(encoding="utf-8"))["left"]
        assert all(group["reason"] for group in groups)
        self._lines = [Line(test) for group in groups for test in group["tests"]]
        self._of_file: dict[str, list[Line]] = {}
        for line in self._lines:
            self._of_file.setdefault(line.file, []).append(line)

    def lines_of(self, node: str) -> list[str]:
        """Lines that mean a test, by its id below ``tests/``."""
        return [line.written for line in self._of_file.get(node.partition("::")[0], []) if line.names(node)]

    def unknown(self, nodes: Iterable[str]) -> list[str]:
        """Lines that mean none of these tests."""
        known = {written for node in nodes for written in self.lines_of(node)}
        return [line.written for line in self._lines if line.written not in known]
