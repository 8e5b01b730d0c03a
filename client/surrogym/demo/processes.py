"""Child processes that never outlive the demo: each in its own process group, stopped together, and watching their
parent."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from surrogym_client.errors import SurrogymClientError

STARTING_SECONDS = 120.0
STOPPING_SECONDS = 10.0
LOOK_SECONDS = 0.05


class RunFailed(SurrogymClientError):
    """A process of a run failed or did not start, or the run folder can't be used."""


@dataclass(frozen=True)
class Child:
    """One child process of a demo, and its log file."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def check(self) -> None:
        """Raise ``RunFailed`` if the process has failed."""
        code = self.process.poll()
        if code:
            raise RunFailed(f"the {self.name} ended with exit code {code}: {self.last_words()} (log: {self.log})")

    def last_words(self) -> str:
        """Return the last line that the process has written to its log."""
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "no output"


class Children:
    """Child processes of one run. Leaving the context stops all of them, also after an error or Ctrl-C."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._children: list[Child] = []

    def start(self, name: str, module: str, arguments: Sequence[str]) -> Child:
        """Start ``python -m module`` as a child process, with a log in the run folder."""
        log = self._folder / f"{name}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments, "--exit-with-parent"],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=_environment(),
                start_new_session=True,
            )
        child = Child(name, process, log)
        self._children.append(child)
        return child

    def check(self) -> None:
        """Raise ``RunFailed`` if any child process has failed."""
        for child in self._children:
            child.check()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop all child processes, one after the other, the newest first, so that none loses the server while it saves
        its work. Kill those that have not ended in time, each in a time of its own."""
        for child in reversed(self._children):
            _signal(child, signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                child.process.wait(STOPPING_SECONDS)
        for child in self._children:
            _signal(child, signal.SIGKILL)
            child.process.wait()


def free_port() -> int:
    """Return a port of this machine that nothing listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def await_file(child: Child, path: Path) -> str:
    """Wait for the file that a child process writes when it is ready, and return the file's content.

    Raises:
        RunFailed: the child process ended before, or took too long.
    """
    deadline = time.monotonic() + STARTING_SECONDS
    while not path.exists():
        if child.process.poll() is not None or time.monotonic() > deadline:
            raise RunFailed(f"the {child.name} did not start: {child.last_words()} (log: {child.log})")
        time.sleep(LOOK_SECONDS)
    return path.read_text(encoding="utf-8").strip()


def _signal(child: Child, number: signal.Signals) -> None:
    """Send a signal to the process group of a child, which may still exist after the child itself has ended."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.process.pid, number)


def _environment() -> dict[str, str]:
    """Return the environment variables of a child process: without Surrogym's settings, and with one thread, because
    the processes share the cores."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SURROGYM_")}
    return {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", **kept}
