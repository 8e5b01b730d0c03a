"""What a remote step costs as lanes and concurrent sessions grow. Run by ``make bench``.

Growth in points and in particles is in bench_predict.py.
"""

from __future__ import annotations

import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from bench_step import TRIVIAL, remote, surrogym_server
from common import parser, slopes, started, write

LANES = (1, 4, 16, 64, 256, 1_024, 4_096)
SESSIONS, SESSION_LANES = (1, 2, 4, 8, 16, 32, 64), 16
SECONDS, QUICK_SECONDS, WARM_UP = 1.5, 0.2, 5


def lanes(url: str, count: int, seconds: float) -> dict[str, float]:
    """Median microseconds of a step of so many lanes, with a model and without."""
    with ExitStack() as stack:
        calls = {name: remote(stack, url, name, "stream", count) for name in ("pendulum", TRIVIAL)}
        return {name: median_us(call, seconds) for name, call in calls.items()}


def median_us(call: Any, seconds: float) -> float:
    for _ in range(WARM_UP):
        call()
    taken, end = [], time.perf_counter() + seconds
    while (start := time.perf_counter()) < end:
        call()
        taken.append(time.perf_counter() - start)
    return 1e6 * statistics.median(taken)


def sessions(url: str, count: int, seconds: float) -> dict[str, float]:
    """Requests per second of so many sessions of Pendulum, each with a thread of its own, and their p50 and p99."""
    with ExitStack() as stack:
        calls = [remote(stack, url, "pendulum", "stream", SESSION_LANES) for _ in range(count)]

        def go(call: Any) -> list[float]:
            taken, end = [], time.perf_counter() + seconds
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
        "requests/s": len(every) / seconds,
        "p50 us": every[len(every) // 2],
        "p99 us": every[int(0.99 * len(every))],
        "fewest/most": fewest / most,
    }


def main() -> None:
    options = started(parser(__doc__))
    seconds = QUICK_SECONDS if options.quick else SECONDS
    report: dict[str, Any] = {"lanes": {}, "sessions": {}}
    with surrogym_server() as url:
        for kind, counts, measure in (("lanes", LANES, lanes), ("sessions", SESSIONS, sessions)):
            for count in counts:
                report[kind][count] = measure(url, count, seconds)
                print(f"{kind} {count:5}  " + "  ".join(f"{k} {v:,.2f}" for k, v in report[kind][count].items()))
    times = [found["pendulum"] for found in report["lanes"].values()]
    report["slopes of lanes"] = slopes(LANES, times)
    print(
        "time grows from each number of lanes to the next by the power", [f"{s:.2f}" for s in report["slopes of lanes"]]
    )
    write(options.out, "growth", report)


if __name__ == "__main__":
    main()
