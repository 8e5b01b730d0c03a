"""A cluster on one machine, all parts of which may be killed: raylets, front servers, HAProxy and PostgreSQL."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from support.haproxy import Proxy, running_proxy
from support.postgresql import Postgresql, running_postgresql
from support.ray_cluster import RayCluster
from support.server import RestartingServer

HOSTS, LEASE_SECONDS = 2, 6.0
STARTING_SECONDS = 200.0  # of a session host that was killed before


@dataclass
class Stage:
    """Running parts of a cluster. ``url`` is the address of HAProxy."""

    postgresql: Postgresql
    cluster: RayCluster
    fronts: list[RestartingServer]
    proxy: Proxy
    url: str

    def kill_raylet(self, number: int) -> None:
        """Kill one raylet with its workers, and start another in its place. 0 is the head's."""
        self.cluster.kill_raylet(number)
        self.cluster.start_node(number)

    def kill_host(self, source: random.Random) -> None:
        """Kill the process of one session host, once all of them run. Ray starts another in its place."""
        deadline = time.monotonic() + STARTING_SECONDS
        while len(hosts := self.cluster.workers("ray::SessionHost")) < HOSTS:
            assert time.monotonic() < deadline, f"{len(hosts)} of {HOSTS} session hosts run"
            time.sleep(0.1)
        os.kill(source.choice(hosts), signal.SIGKILL)

    def kill_head(self) -> None:
        """Kill the head with its processes. Then build the cluster again, with front servers of its own."""
        self.cluster.kill_node(0)
        self.cluster.kill()
        for front in self.fronts:
            front.stop(signal.SIGKILL)
        self.cluster.start()
        for front in self.fronts:
            front.start()

    def kill_postgresql(self) -> None:
        self.postgresql.kill()
        self.postgresql.start()

    def kill_proxy(self) -> None:
        self.proxy.kill()
        self.proxy.start()

    def kill_front(self, number: int) -> None:
        self.fronts[number].stop(signal.SIGKILL)
        self.fronts[number].start()


@contextmanager
def running_stage(folder: Path) -> Iterator[Stage]:
    """Three raylets, of which the head's has no CPU, two front servers behind HAProxy, and PostgreSQL."""
    with ExitStack() as stack:
        short = Path(stack.enter_context(TemporaryDirectory(prefix="ray")))
        postgresql = stack.enter_context(running_postgresql())
        cluster = RayCluster(short, 0, (2, 2))
        stack.callback(cluster.kill)
        cluster.start()
        options = ("--database", postgresql.new_database(), "--engine", "ray", "--ray-address", cluster.address)
        environment = {"SURROGYM_RAY_LEASE_SECONDS": str(LEASE_SECONDS), "OMP_NUM_THREADS": "1"}
        fronts = []
        for number in range(2):
            own = folder / f"front-{number}"
            own.mkdir()
            fronts.append(RestartingServer(own, *options, "--ray-hosts", str(HOSTS), **environment))
            stack.callback(fronts[-1].stop)
        servers = [front.url.removeprefix("http://") for front in fronts]
        proxy = stack.enter_context(running_proxy(folder, servers))
        yield Stage(postgresql, cluster, fronts, proxy, proxy.url)


@contextmanager
def killing_fronts(stage: Stage, seconds: float) -> Iterator[list[int]]:
    """Kill front servers in turn, one every ``seconds`` if one is ready by then. Yields the numbers of the killed."""
    killed: list[int] = []
    ending = threading.Event()

    def kill_in_turn(pool: ThreadPoolExecutor) -> None:
        starts: dict[int, Future[None]] = {}
        while not ending.wait(seconds):
            ready = [number for number in range(len(stage.fronts)) if number not in starts or starts[number].done()]
            if ready:
                number = min(ready, key=killed.count)
                stage.fronts[number].stop(signal.SIGKILL)
                killed.append(number)
                starts[number] = pool.submit(stage.fronts[number].start)
        for start in starts.values():
            start.result()

    with ThreadPoolExecutor() as pool:
        killing = pool.submit(kill_in_turn, pool)
        try:
            yield killed
        finally:
            ending.set()
            killing.result()
