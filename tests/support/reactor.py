"""Logs of the reactor of the examples, whole or broken in ten ways."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

EXAMPLE = Path(__file__).parents[2] / "examples" / "reactor.py"

# What a person knows of the plant: the coolant's range, and that neither state leaves these ends.
MAPPING: dict[str, Any] = {
    "state": {"c": "concentration", "T": "temperature"},
    "action": {"coolant": "action_coolant"},
    "next": {"c": "next_concentration", "T": "next_temperature"},
    "reward": "reward",
    "terminated": "terminated",
    "episode": "run",
    "time": "time",
    "limits": {"c": [0, 1], "T": [250, 400], "coolant": [280, 320]},
}


def example() -> ModuleType:
    """The example as a module."""
    found = importlib.util.spec_from_file_location("reactor", EXAMPLE)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Log:
    """Rows of text under a heading."""

    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def write(self, path: Path) -> Path:
        lines = [",".join(row) for row in (self.heading, *self.rows)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    def at(self, row: int, column: str, text: str) -> Log:
        """The same with another cell."""
        cells = list(self.rows[row])
        cells[self.heading.index(column)] = text
        return replace(self, rows=(*self.rows[:row], tuple(cells), *self.rows[row + 1 :]))

    def without(self, *columns: str) -> Log:
        kept = [i for i, name in enumerate(self.heading) if name not in columns]
        rows = tuple(tuple(row[i] for i in kept) for row in self.rows)
        return Log(tuple(self.heading[i] for i in kept), rows)


def log(runs: int = 4, length: int = 25, seed: int = 0) -> Log:
    """A log with next states and terminations, none of which is 1."""
    module = example()
    heading = (*module.HEADING, *module.FOLLOWING, "terminated")
    rows = tuple((*map(repr, row), "0") for row in module.operate(runs, length, seed))
    return Log(heading, rows)


WAYS = {
    "nan": "temperature: not a number: nan",
    "infinite": "temperature: expected a finite number, got inf",
    "missing": "action_coolant: missing",
    "too few columns": "expected 9 columns, got 7",
    "too many columns": "expected 9 columns, got 10",
    "text": "concentration: expected a number, got 'error'",
    "out of bounds": "temperature: expected a value in [250, 400], got 999",
    "duplicated": "repeats line",
    "going on after its end": "continues the episode, got 1",
    "backwards": "time: expected a time after",
    "action": "action_coolant: expected a value in [280, 320], got 350",
}


def broken(whole: Log, share: float, seed: int = 0) -> tuple[Log, dict[int, str]]:
    """The log with a share of its rows broken, in all the ways in turn; and the way of each broken line."""
    rng = np.random.default_rng(seed)
    length = sum(row[0] == "0" for row in whole.rows)
    inner = [row for row in range(len(whole.rows)) if 2 <= row % length < length - 2]
    places = np.sort(rng.choice(np.array(inner)[::4], round(share * len(whole.rows)), replace=False)).tolist()
    found = {row: list(WAYS)[number % len(WAYS)] for number, row in enumerate(places)}
    for row, way in found.items():
        whole = _break(whole, row, way)
    return whole, {row + 2: way for row, way in found.items()}  # line 1 is the heading


def _break(whole: Log, row: int, way: str) -> Log:
    cells = whole.rows[row]
    match way:
        case "nan":
            return whole.at(row, "temperature", "nan")
        case "infinite":
            return whole.at(row, "temperature", "inf")
        case "missing":
            return whole.at(row, "action_coolant", "")
        case "text":
            return whole.at(row, "concentration", "error")
        case "out of bounds":
            return whole.at(row, "temperature", "999")
        case "going on after its end":
            return whole.at(row, "terminated", "1")
        case "backwards":
            return whole.at(row, "time", repr(float(cells[1]) - 1000))
        case "action":
            return whole.at(row, "action_coolant", "350")
    replaced = {
        "too few columns": cells[:-2],
        "too many columns": (*cells, "1"),
        "duplicated": whole.rows[row - 1],
    }[way]
    return replace(whole, rows=(*whole.rows[:row], replaced, *whole.rows[row + 1 :]))
