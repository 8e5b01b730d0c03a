"""What the engine ``ray`` adds to a step, beside ``local`` in one run: three raylets, two front servers behind HAProxy,
and PostgreSQL, on one machine. Before that, ``surrogym conformance`` runs against each address.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}

import numpy as np
from common import parser, started, take_turns, timed, write

from support.haproxy import program, running_proxy
from support.postgresql import running_postgresql
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate, Transport
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import OpenSession

TRANSPORTS: tuple[Transport, ...] = ("stream", "binary")
LANES = (1, 1_024, 16_384)
CALLS = {1: 60, 1_024: 40, 16_384: 10}
ROUNDS, HOSTS, SAMPLES = 8, 2, 50


@contextmanager
def raylets() -> Iterator[str]:
    """The address of a cluster of three raylets."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield str(cluster.address)
    finally:
        cluster.shutdown()


def conforms(url: str) -> str:
    """The last line of ``surrogym conformance``."""
    command = [sys.executable, "-m", "surrogym", "conformance", "--server", url]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = (ended.stdout.strip() or ended.stderr.strip()).splitlines()
    return f"exit code {ended.returncode}: {lines[-1] if lines else ''}"


def steps(urls: dict[str, str], lanes: int, rounds: int) -> dict[str, float]:
    """Median milliseconds of a step for each way to a session."""
    with ExitStack() as stack:
        ways = {}
        for name, url in urls.items():
            for transport in TRANSPORTS:
                port = stack.enter_context(HttpSurrogate(url, "pendulum", transport=transport))
                session = port.open(OpenSession(num_envs=lanes, seed=1)).id
                port.reset(session)
                ways[f"{name} {transport}"] = timed(partial(port.step, session, np.zeros((lanes, 1))))
        turns = take_turns(ways, rounds, CALLS[lanes], 5)
    return {name: 1e3 * float(np.median(np.concatenate(taken))) for name, taken in turns.items()}


def main() -> None:
    options = started(parser(__doc__))
    if program() is None:
        raise SystemExit("HAProxy is not on this machine: apt-get install haproxy")
    with ExitStack() as stack:
        folders = [Path(stack.enter_context(tempfile.TemporaryDirectory())) for _ in range(4)]
        postgresql = stack.enter_context(running_postgresql())
        address = stack.enter_context(raylets())
        shared = ("--database", postgresql.new_database(), "--log-level", "warning")
        cluster = ("--engine", "ray", "--ray-address", address, "--ray-hosts", str(HOSTS))
        fronts = [stack.enter_context(running_server(folder, *shared, *cluster)) for folder in folders[:2]]
        local = stack.enter_context(running_server(folders[2], *shared))
        hosts = [front.url.removeprefix("http://") for front in fronts]
        proxy = stack.enter_context(running_proxy(folders[3], hosts))
        time.sleep(3.0)  # until HAProxy has looked at its servers
        with Api(local.url) as api:
            teach(api, "pendulum", pendulum(), queries=SAMPLES)
        urls = {"local": local.url, "front": fronts[0].url, "proxy": proxy.url}
        said = {name: conforms(url) for name, url in {**urls, "other front": fronts[1].url}.items()}
        for name, line in said.items():
            print(f"conformance, {name}: {line}")
        report = {}
        for lanes in LANES:
            report[lanes] = steps(urls, lanes, 2 if options.quick else ROUNDS)
            print(f"{lanes:6,} lanes  " + "  ".join(f"{name} {ms:.2f} ms" for name, ms in report[lanes].items()))
    write(options.out, "cluster", {"conformance": said, "steps": report})


if __name__ == "__main__":
    main()
