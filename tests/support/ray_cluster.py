"""A Ray cluster of its own processes, as ``ray start`` begins it. Raylets, or all of it, may be killed and started."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

STARTING_SECONDS, ATTEMPTS = 200.0, 6
OBJECT_STORE_BYTES = 100_000_000


class RayCluster:
    """A head with its processes, and further raylets on the same machine.

    Args:
        folder: of logs and sessions; its path has to be short, as sockets are in it.
        cpus: of the head.
        raylets: CPUs of each further raylet.
        niceness: of the processes that run tasks and actors; Ray's default is 15.
    """

    def __init__(self, folder: Path, cpus: int, raylets: Sequence[int] = (), niceness: int = 0) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"127.0.0.1:{self._port}"
        self._folder, self._cpus, self._begun = folder, (cpus, *raylets), 0
        self._niceness = str(niceness)
        self._nodes: dict[int, subprocess.Popen[bytes]] = {}  # by number; 0 is the head

    def start(self) -> None:
        """Begin, and wait until the head listens and all raylets have joined it."""
        self._begun += 1
        for number in range(len(self._cpus)):
            self.start_node(number)

    def start_node(self, number: int) -> None:
        """Begin the head (0) or another raylet, and wait until it runs. ``ray start`` gives up after 30 s, which a busy
        machine may need, so it gets several attempts."""
        for _ in range(ATTEMPTS):
            if self._started(number):
                return
        raise AssertionError(self._log(number).read_text())

    def _started(self, number: int) -> bool:
        """Begin a node, and wait until it runs or has given up."""
        command = [str(Path(sys.executable).parent / "ray"), "start", "--block", "--num-cpus", str(self._cpus[number])]
        if number == 0:
            command += ["--head", "--port", str(self._port), "--include-dashboard", "false"]
            command += ["--temp-dir", str(self._folder / str(self._begun))]
        else:
            command += ["--address", self.address]
        if len(self._cpus) > 1:  # the raylets of one machine share its ports and its memory
            command += ["--min-worker-port", "0", "--max-worker-port", "0"]
            command += ["--object-store-memory", str(OBJECT_STORE_BYTES)]
        said = self._runs(number)
        with self._log(number).open("ab") as log:
            environment = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": self._niceness}
            node = self._nodes[number] = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        deadline = time.monotonic() + STARTING_SECONDS
        while self._runs(number) == said:
            if node.poll() is not None or time.monotonic() > deadline:
                self.kill_node(number)
                return False
            time.sleep(0.1)
        return True

    def _log(self, number: int) -> Path:
        return self._folder / f"log-{number}"

    def _runs(self, number: int) -> int:
        """How often a node has begun to run."""
        return self._log(number).read_text().count("Ray runtime started") if self._log(number).exists() else 0

    def kill_raylet(self, number: int) -> None:
        """Kill the process ``raylet`` of a node alone, and wait until ``ray start`` has ended the rest of the node."""
        node = self._nodes.pop(number)
        [raylet] = [pid for pid in descendants(node.pid) if _name(pid) == "raylet"]
        os.kill(raylet, signal.SIGKILL)
        node.wait(STARTING_SECONDS)

    def workers(self, title: str) -> list[int]:
        """The processes of the cluster whose title begins so: Ray puts an actor's class there."""
        inside = set().union(*(descendants(node.pid) for node in self._nodes.values()))
        return sorted(pid for pid in inside if _title(pid).startswith(title))

    def kill_node(self, number: int) -> None:
        """End all processes of the head (0) or of another node at once."""
        if (node := self._nodes.pop(number, None)) is not None:
            kill_all(descendants(node.pid))
            node.wait()

    def kill(self) -> None:
        """End all processes of all nodes at once."""
        kill_all(set().union(*(descendants(node.pid) for node in self._nodes.values())))
        for number in list(self._nodes):
            self._nodes.pop(number).wait()


def descendants(root: int) -> set[int]:
    """A process and all that it has begun, by /proc."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    found, size = {root}, 0
    while len(found) > size:
        size = len(found)
        found |= {child for child, parent in parents.items() if parent in found}
    return found


def _name(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/comm").read_text().strip()
    return ""


def _title(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text(errors="replace")
    return ""


def kill_all(pids: set[int]) -> None:
    """Send SIGKILL to each of these processes that still exists."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
