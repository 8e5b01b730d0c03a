"""A step through a session host whose niceness is 0, beside one with Ray's default of 15, while other programs keep the
cores busy. Both clusters run at once, and their steps take turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}

import numpy as np
from common import parser, started, take_turns, timed, write

from support.postgresql import Postgresql, running_postgresql
from support.ray_cluster import RayCluster
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import OpenSession

NICENESS = (0, 15)
LANES = (1, 1_024)
CALLS, ROUNDS, SAMPLES = 30, 10, 12


@contextmanager
def front(postgresql: Postgresql, niceness: int) -> Iterator[str]:
    """The address of a front server whose session host runs with a niceness."""
    with ExitStack() as stack:
        short, folder = (Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ray"))) for _ in range(2))
        cluster = RayCluster(short, 0, (2,), niceness)
        stack.callback(cluster.kill)
        cluster.start()
        options = ("--database", postgresql.new_database(), "--engine", "ray", "--ray-address", cluster.address)
        yield stack.enter_context(running_server(folder, *options, "--ray-hosts", "1")).url


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Programs that compute without end, at niceness 0."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def steps(urls: dict[int, str], lanes: int, rounds: int) -> dict[int, tuple[float, float]]:
    """Median and 99th percentile of a step in milliseconds, by niceness."""
    with ExitStack() as stack:
        ways = {}
        for niceness, url in urls.items():
            port = stack.enter_context(HttpSurrogate(url, "pendulum"))
            session = port.open(OpenSession(num_envs=lanes, seed=1)).id
            port.reset(session)
            ways[str(niceness)] = timed(partial(port.step, session, np.zeros((lanes, 1))))
        turns = take_turns(ways, rounds, CALLS, 5)
    return {
        int(name): (1e3 * float(np.median(taken)), 1e3 * float(np.percentile(taken, 99)))
        for name, taken in ((name, np.concatenate(blocks)) for name, blocks in turns.items())
    }


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--busy", type=int, nargs="+", default=[0, 1], help="numbers of busy programs")
    options = started(options)
    report: dict[str, dict[int, tuple[float, float]]] = {}
    with ExitStack() as stack:
        postgresql = stack.enter_context(running_postgresql())
        urls = {niceness: stack.enter_context(front(postgresql, niceness)) for niceness in NICENESS}
        for url in urls.values():
            with Api(url) as api:
                teach(api, "pendulum", pendulum(), queries=SAMPLES)
        for lanes in LANES:
            for count in options.busy:
                with busy(count):
                    found = report[f"{lanes} lanes, {count} busy"] = steps(urls, lanes, 2 if options.quick else ROUNDS)
                told = "  ".join(f"niceness {n}: {m:.2f} ms, 99 % {p:.2f} ms" for n, (m, p) in found.items())
                print(f"{lanes:6,} lanes, {count} busy programs  {told}  load {os.getloadavg()[0]:.1f}", flush=True)
    write(options.out, "niceness", report)


if __name__ == "__main__":
    main()
