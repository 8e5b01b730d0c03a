"""What showing all surrogates costs where there are a thousand and ten thousand of them. Run by ``make bench``.

A server of its own looks at a SQLite file; half of the surrogates are finished, half wait for a sampler.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
from common import parser, started, write

from support.many import fill
from support.server import running_server

COUNTS, REQUESTS = (1_000, 10_000), 15
PATHS = ("/metrics", "/v1/surrogates", "/v1/surrogates?limit=100")
IDLE_SECONDS = 5.0
TICK_MS = 10.0


def processor_ms(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return TICK_MS * (int(fields[11]) + int(fields[12]))


def measured(client: httpx.Client, path: str, pid: int, requests: int) -> dict[str, float]:
    """Median milliseconds of a request, and the server's processor time for one."""
    client.get(path).raise_for_status()
    taken, before = [], processor_ms(pid)
    for _ in range(requests):
        start = time.perf_counter()
        client.get(path).raise_for_status()
        taken.append(1e3 * (time.perf_counter() - start))
    return {"ms": statistics.median(taken), "processor ms": (processor_ms(pid) - before) / requests}


def idle(pid: int) -> float:
    """Processor time a second, in ms, of a server that nobody asks anything: its looks at what is due."""
    before = processor_ms(pid)
    time.sleep(IDLE_SECONDS)
    return (processor_ms(pid) - before) / IDLE_SECONDS


def of(count: int, requests: int) -> dict[str, dict[str, float]]:
    with TemporaryDirectory() as folder:
        fill(Path(folder) / "surrogym.db", count)
        with (
            running_server(Path(folder), "--log-level", "warning") as server,
            httpx.Client(base_url=server.url, timeout=120) as client,
        ):
            found = {path: measured(client, path, server.process.pid, requests) for path in PATHS}
            return found | {"idle": {"processor ms a second": idle(server.process.pid)}}


def main() -> None:
    options = started(parser(__doc__))
    report = {}
    for count in COUNTS:
        report[count] = of(count, 3 if options.quick else REQUESTS)
        for what, figures in report[count].items():
            print(f"{count:6,} surrogates  {what:26}" + "  ".join(f"{k} {v:.1f}" for k, v in figures.items()))
    write(options.out, "lists", {"surrogates": report})


if __name__ == "__main__":
    main()
