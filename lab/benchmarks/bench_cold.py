"""Processor time of a step in process by what happens between two steps: why a step in a server is no step in a loop.

Run by ``make bench``. A server's step always comes after a wait in the kernel and work on the reply before.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_step import in_process, stepping, surrogym_server
from common import MICROSECONDS, parser, started, write

LANES = (1, 1_024)
ROUNDS, CALLS, WARM_UP = 12, 40, 300
MEGABYTE = 1_000_000 // 8  # in numbers of double precision


def breaks() -> dict[str, Callable[[], object]]:
    """What may happen between two steps."""
    read, write_end = os.pipe()
    some, much = np.zeros(4 * MEGABYTE), np.zeros(16 * MEGABYTE)
    return {
        "nothing": lambda: None,
        "a byte through a pipe": lambda: (os.write(write_end, b"x"), os.read(read, 1)),
        "wait of 0 s": lambda: time.sleep(0),
        "wait of 0.2 ms": lambda: time.sleep(2e-4),
        "4 MB read": some.sum,
        "16 MB read": much.sum,
    }


def main() -> None:
    options = started(parser(__doc__))
    report: dict[str, Any] = {}
    with surrogym_server() as url:
        port = in_process(url)
        for lanes in LANES:
            step, between = stepping(port, lanes), breaks()
            for _ in range(WARM_UP):
                step()
            taken: dict[str, list[float]] = {name: [] for name in between}
            for _ in range(2 if options.quick else ROUNDS):
                for name, happens in between.items():
                    for _ in range(CALLS):
                        happens()
                        start = time.thread_time()
                        step()
                        taken[name].append(time.thread_time() - start)
            report[str(lanes)] = {name: MICROSECONDS * statistics.median(times) for name, times in taken.items()}
            print(f"N = {lanes:,}, processor time of a step after")
            for name, median in report[str(lanes)].items():
                print(f"  {name:24}{median:8.0f} us")
    write(options.out, "cold", {"us": report})


if __name__ == "__main__":
    main()
