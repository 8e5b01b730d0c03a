"""What a remote step costs as lanes and concurrent sessions grow. Run by ``make bench``.

Growth in points and in particles is in bench_predict.py.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench_step import TRIVIAL, machine, remote, surrogym_server

LANES = (1, 4, 16, 64, 256, 1_024, 4_096)
SESSIONS, SESSION_LANES = (1, 2, 4, 8, 16, 32, 64), 16
SECONDS, WARM_UP = 1.5, 5


def lanes(url: str, count: int) -> dict[str, float]:
    """Median microseconds of a step of so many lanes, with a model and without."""
    with ExitStack() as stack:
        calls = {name: remote(stack, url, name, "stream", count) for name in ("pendulum", TRIVIAL)}
        return {name: median_us(call) for name, call in calls.items()}


def median_us(call: Any) -> float:
    for _ in range(WARM_UP):
        call()
    taken, end = [], time.perf_counter() + SECONDS
    while (start := time.perf_counter()) < end:
        call()
        taken.append(time.perf_counter() - start)
    return 1e6 * statistics.median(taken)


def sessions(url: str, count: int) -> dict[str, float]:
    """Requests per second of so many sessions of Pendulum, each with a thread of its own, and their p50 and p99."""
    with ExitStack() as stack:
        calls = [remote(stack, url, "pendulum", "stream", SESSION_LANES) for _ in range(count)]

        def go(call: Any) -> list[float]:
            taken, end = [], time.perf_counter() + SECONDS
            while (start := time.perf_counter()) < end:
                call()
                taken.append(1e6 * (time.perf_counter() - start))
            return taken

        for call in calls:
            call()
        with ThreadPoolExecutor(count) as threads:
            each = list(threads.map(go, calls))
    every = sorted(us for taken in each for us in taken)
    fewest, most = min(map(len, each)), max(map(len, each))
    return {
        "requests/s": len(every) / SECONDS,
        "p50 us": every[len(every) // 2],
        "p99 us": every[int(0.99 * len(every))],
        "fewest/most": fewest / most,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks"), help="folder of the JSON file")
    options = parser.parse_args()
    report: dict[str, Any] = {"machine": machine(), "lanes": {}, "sessions": {}}
    with surrogym_server() as url:
        for kind, counts, measure in (("lanes", LANES, lanes), ("sessions", SESSIONS, sessions)):
            for count in counts:
                report[kind][count] = measure(url, count)
                print(f"{kind} {count:5}  " + "  ".join(f"{k} {v:,.2f}" for k, v in report[kind][count].items()))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "growth.json").write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
