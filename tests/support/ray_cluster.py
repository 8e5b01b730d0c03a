"""A Ray cluster of its own processes, as ``ray start`` begins it, which may be killed whole and begun again."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

STARTING_SECONDS = 60.0


class RayCluster:
    """A head with its processes.

    Args:
        folder: of logs and sessions; its path has to be short, as sockets are in it.
        cpus: of the cluster.
    """

    def __init__(self, folder: Path, cpus: int) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"127.0.0.1:{self._port}"
        self._folder, self._cpus, self._begun = folder, cpus, 0
        self._head: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Begin, and wait until the head listens."""
        self._begun += 1
        command = [Path(sys.executable).parent / "ray", "start", "--head", "--block", "--port", str(self._port)]
        command += ["--num-cpus", str(self._cpus), "--include-dashboard", "false"]
        command += ["--temp-dir", self._folder / str(self._begun)]
        with (self._folder / "log").open("ab") as log:
            environment = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0"}
            self._head = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        deadline = time.monotonic() + STARTING_SECONDS
        while (self._folder / "log").read_text().count("Ray runtime started") < self._begun:
            if self._head.poll() is not None or time.monotonic() > deadline:
                self.kill()
                raise AssertionError((self._folder / "log").read_text())
            time.sleep(0.1)

    def kill(self) -> None:
        """End all of its processes at once."""
        if self._head is not None:
            for pid in _descendants(self._head.pid):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self._head.wait()
            self._head = None


def _descendants(root: int) -> set[int]:
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
