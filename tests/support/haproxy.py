"""A real HAProxy before servers of this machine, with the settings of docker/haproxy.cfg."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

CONFIGURATION = Path(__file__).parents[2] / "docker" / "haproxy.cfg"
STARTING_SECONDS = 60.0


def program() -> str | None:
    """Where HAProxy is, if it is installed."""
    return shutil.which("haproxy", path=f"{os.environ.get('PATH', '')}:/usr/sbin")


def configuration(port: int, servers: Sequence[str]) -> str:
    """The file of the compose profile, with a port and servers of this machine."""
    template, names = "    server-template front 16 front:8000 resolvers names init-addr none", "resolvers names"
    text = CONFIGURATION.read_text(encoding="utf-8")
    assert template in text
    own = "\n".join(f"    server front{number} {server}" for number, server in enumerate(servers))
    before, _, after = text.replace(template, own).replace("bind :8000", f"bind 127.0.0.1:{port}").partition(names)
    return before + after[after.index("frontend") :]  # without names to look up


class Proxy:
    """A running HAProxy. It may be killed and started again.

    Args:
        folder: of its configuration.
        servers: addresses ``host:port``.
    """

    def __init__(self, folder: Path, servers: Sequence[str]) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self._port}"
        self._file = folder / "haproxy.cfg"
        self._file.write_text(configuration(self._port, servers), encoding="utf-8")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen([str(program()), "-db", "-f", self._file], stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + STARTING_SECONDS
        while True:
            try:
                socket.create_connection(("127.0.0.1", self._port), 1.0).close()
                return
            except OSError:
                assert self._process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.05)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


@contextmanager
def running_proxy(folder: Path, servers: Sequence[str]) -> Iterator[Proxy]:
    proxy = Proxy(folder, servers)
    proxy.start()
    try:
        yield proxy
    finally:
        proxy.kill()
