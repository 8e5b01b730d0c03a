"""What the benchmarks share: options, the machine in words, subjects that take turns, and the JSON file."""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

OUT = Path("build/benchmarks")
MICROSECONDS = 1e6  # of a second

Call = Callable[[], Any]
Subject = Callable[[int], list[float]]  # seconds that each of so many calls took
Turns = dict[str, list[list[float]]]  # of each subject, the seconds of its calls, a list a round


def parser(what: str | None) -> argparse.ArgumentParser:
    """The options that every part takes."""
    made = argparse.ArgumentParser(description=what)
    made.add_argument("--out", type=Path, default=OUT, help="folder of the JSON files")
    made.add_argument("--quick", action="store_true", help="a look: few rounds, few sizes")
    return made


def started(made: argparse.ArgumentParser) -> argparse.Namespace:
    """Options as given; from here on lines are printed as they come, and torch has one thread."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    torch.set_num_threads(1)
    # Otherwise each program that a benchmark starts would compile all that it imports, for half of its start.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    return made.parse_args()


def write(out: Path, name: str, report: Mapping[str, Any]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps({"machine": machine(), **report}, indent=1))


def machine() -> dict[str, Any]:
    return {
        "time": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "cores": os.cpu_count(),
        "processor": _processor(),
        "load": [round(load, 2) for load in os.getloadavg()],
        "platform": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def timed(call: Call) -> Subject:
    """A subject of this process."""

    def calls(count: int) -> list[float]:
        taken = []
        for _ in range(count):
            start = time.perf_counter()
            call()
            taken.append(time.perf_counter() - start)
        return taken

    return calls


def take_turns(subjects: Mapping[str, Subject], rounds: int, calls: int, warm_up: int) -> Turns:
    """Rounds of so many calls of each, one subject after the other, so that what else the machine does hits all
    alike."""
    for subject in subjects.values():
        subject(warm_up)
    turns: Turns = {name: [] for name in subjects}
    for _ in range(rounds):
        for name, subject in subjects.items():
            turns[name].append(subject(calls))
    return turns


def figures(rounds: Sequence[Sequence[float]]) -> dict[str, float]:
    """p50 and p99 of all calls, in microseconds."""
    every = np.concatenate([np.array(taken) for taken in rounds]) * MICROSECONDS
    return {"p50": float(np.quantile(every, 0.5)), "p99": float(np.quantile(every, 0.99))}


def ratio(rounds: Sequence[Sequence[float]], beside: Sequence[Sequence[float]]) -> float:
    """Median over the rounds of one subject's median over the other's in the same round."""
    return statistics.median(statistics.median(a) / statistics.median(b) for a, b in zip(rounds, beside, strict=True))


def slopes(x: Sequence[float], y: Sequence[float]) -> list[float]:
    """By which power y grows from each x to the next."""
    return [math.log(y[i + 1] / y[i]) / math.log(x[i + 1] / x[i]) for i in range(len(x) - 1)]


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor()


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row to a CSV file, whose header the first row writes."""
    new = not path.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
