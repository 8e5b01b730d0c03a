"""A real server process on any free port, with its SQLite file in a folder of the test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from support.nursery import Forked, nursery, reads_early

COLD = ("-m", "surrogym_server")
STARTING_SECONDS = 400.0  # of a machine on which much else runs
STOPPING_SECONDS = 60.0


@dataclass
class ServerProcess:
    """A running server. ``url`` is where it listens, ``log`` what it has said."""

    url: str
    process: subprocess.Popen[bytes] | Forked
    folder: Path

    @property
    def log(self) -> str:
        return (self.folder / "server.log").read_text()

    def stop(self, sig: int = signal.SIGTERM) -> int:
        """Send a signal and wait for the end; returns the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(sig)
        return self.process.wait(STOPPING_SECONDS)


def start_server(
    folder: Path, *options: str, program: Sequence[str] | None = None, **environment: str
) -> ServerProcess:
    """Start ``surrogym serve`` on the database of a folder, and wait until it accepts requests.

    It is a fork of a process that has imported the server, where that makes no difference; see ``support.nursery``.

    Args:
        folder: holds database and log; starting again in it goes on with its database.
        options: further options of the command.
        program: arguments of Python before the command ``serve``; they start the server cold. See ``COLD``.
        environment: further environment variables.
    """
    ready = folder / "ready"
    ready.unlink(missing_ok=True)
    defaults = ["--port", "0", "--database", str(folder / "surrogym.db"), "--ready-file", str(ready)]
    process = _process(folder / "server.log", program, ["serve", *defaults, *options], environment, Path.cwd())
    deadline = time.monotonic() + STARTING_SECONDS
    while not ready.exists():
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            raise AssertionError(f"the server did not start: {(folder / 'server.log').read_text()}")
        time.sleep(0.02)
    return ServerProcess(ready.read_text(), process, folder)


def ended(folder: Path, *arguments: str, **environment: str) -> tuple[int, str]:
    """Exit status and output of ``python -m surrogym_server ARGUMENTS``, run to its end in a folder."""
    log = folder / "program.log"
    log.unlink(missing_ok=True)
    status = _process(log, None, list(arguments), environment, folder).wait(STARTING_SECONDS)
    return status, log.read_text()


def refusal(folder: Path, *options: str, **environment: str) -> str:
    """The one sentence with which ``surrogym serve`` refuses to start."""
    status, said = ended(folder, "serve", *options, **environment)
    assert status == 1, said
    (line,) = said.strip().splitlines()
    return line


def _process(
    path: Path, program: Sequence[str] | None, arguments: list[str], added: dict[str, str], folder: Path
) -> subprocess.Popen[bytes] | Forked:
    """Start a program of the server with this environment, but for settings of a server, and further variables."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SURROGYM_")} | added
    with path.open("ab") as log:
        if program is None and not reads_early(added) and (forking := nursery()) is not None:
            return forking.start(arguments, log, environment, folder)
        command = [sys.executable, *(program or COLD), *arguments]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, cwd=folder)


@contextmanager
def running_server(folder: Path, *options: str, **environment: str) -> Iterator[ServerProcess]:
    """A server for the time of the context."""
    server = start_server(folder, *options, **environment)
    try:
        yield server
    finally:
        if server.process.poll() is None:
            server.stop()


class RestartingServer:
    """A server that can be stopped and started at the same address, on the same database."""

    def __init__(self, folder: Path, *options: str, **environment: str) -> None:
        self._folder = folder
        self._options = options
        self._environment = environment
        self._server = start_server(folder, *options, **environment)
        self.url = self._server.url

    @property
    def process(self) -> subprocess.Popen[bytes] | Forked:
        return self._server.process

    @property
    def log(self) -> str:
        return self._server.log

    def start(self) -> None:
        port = self.url.rpartition(":")[2]
        self._server = start_server(self._folder, *self._options, "--port", port, **self._environment)

    def stop(self, sig: int = signal.SIGTERM) -> int:
        return self._server.stop(sig)
