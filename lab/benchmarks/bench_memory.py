"""Resident memory of a server that steps 64 sessions of 256 lanes each for ten minutes: flat, or it leaks.

Run by ``make bench-memory`` (ARGS="--minutes 1" for a look). Sessions take turns over their streams from one process,
with a pause between rounds so that the rest of the machine goes on.
"""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from bench_step import process_ids, surrogym_server
from common import parser, started, write

from surrogym_client.transport import HttpSurrogate
from surrogym_shared.wire import OpenSession

SESSIONS, LANES = 64, 256
WARM_UP_ROUNDS = 200  # until every session keeps as much as it ever will, rewards that are not summed yet included
READINGS = 60
PAUSE_SECONDS = 0.1
FLAT = 0.03  # share by which the mean of the last quarter may exceed that of the first


def resident_mib(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return float(status.partition("VmRSS:")[2].split()[0]) / 1024


def run(url: str, pid: int, minutes: float) -> tuple[list[tuple[float, float]], int]:
    """(seconds, MiB) of readings spread over the time, and how many steps of all lanes were made."""
    rng, readings, steps = np.random.default_rng(0), [], 0
    with ExitStack() as stack:
        port = stack.enter_context(HttpSurrogate(url, "pendulum", transport="stream"))
        ids = [port.open(OpenSession(num_envs=LANES, seed=seed)).id for seed in range(SESSIONS)]
        for id in ids:
            port.reset(id)

        def one_round() -> None:
            action = rng.uniform(-2, 2, (LANES, 1))
            for id in ids:
                port.step(id, action)

        for _ in range(WARM_UP_ROUNDS):
            one_round()
        start = time.monotonic()
        while (elapsed := time.monotonic() - start) < 60 * minutes:
            one_round()
            steps += SESSIONS * LANES
            if elapsed >= len(readings) * 60 * minutes / READINGS:
                readings.append((elapsed, resident_mib(pid)))
            time.sleep(PAUSE_SECONDS)
        for id in ids:
            port.close(id)
    return readings, steps


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--minutes", type=float, default=10.0)
    options = started(made)
    minutes = min(options.minutes, 0.5) if options.quick else options.minutes
    with surrogym_server() as url:
        readings, steps = run(url, process_ids["surrogym"], minutes)
    mib = np.array([m for _, m in readings])
    quarter = max(1, len(mib) // 4)
    growth = float(mib[-quarter:].mean() / mib[:quarter].mean() - 1)
    report: dict[str, Any] = {"steps": steps, "growth": growth, "readings": readings}
    print(f"{SESSIONS} sessions of {LANES} lanes, {minutes:g} minutes, {steps:,} environment steps")
    print(
        f"resident: {mib.min():.1f} to {mib.max():.1f} MiB after the warm-up, last quarter {growth:+.2%} of the first"
    )
    write(options.out, "memory", report)
    sys.exit(growth > FLAT)


if __name__ == "__main__":
    main()
