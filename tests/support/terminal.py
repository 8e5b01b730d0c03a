"""A program on a terminal of its own, as wide as a test wants it."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

PATIENCE = 240.0
UPWARDS = re.compile(r"\x1b\[\d*A")  # what follows is drawn on a line of its own
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@dataclass
class Terminal:
    process: subprocess.Popen[bytes]
    descriptor: int
    _said: bytes = b""  # kept as it came: a read may end within a character or a control sequence

    @property
    def shown(self) -> str:
        """All that was shown since the start, without control sequences."""
        return CONTROL.sub("", UPWARDS.sub("\n", self._said.decode(errors="replace")))

    def await_text(self, text: str) -> None:
        """Read until ``text`` has been shown since the start."""
        deadline = time.monotonic() + PATIENCE
        while text not in self.shown:
            assert time.monotonic() < deadline, self.shown[-2_000:]
            assert self._read(0.2) or self.process.poll() is None, self.shown[-2_000:]

    def interrupt(self, number: int = signal.SIGINT) -> int:
        """Press Ctrl-C, or send another signal; the exit status, once everything it said is read."""
        self.process.send_signal(number)
        deadline = time.monotonic() + PATIENCE
        while self._read(0.2) or self.process.poll() is None:
            assert time.monotonic() < deadline, self.shown[-2_000:]
        return self.process.wait()

    def _read(self, seconds: float) -> bool:
        if not select.select([self.descriptor], [], [], seconds)[0]:
            return False
        try:
            said = os.read(self.descriptor, 65_536)
        except OSError:  # the other end is closed
            return False
        self._said += said
        return bool(said)


def _heed_interrupts() -> None:
    """A shell that starts the tests in the background has them, and their children, ignore Ctrl-C and hang-ups."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def on_terminal(
    *arguments: str, module: str = "surrogym", width: int = 80, folder: str | None = None
) -> Iterator[Terminal]:
    """``python -m MODULE ARGUMENTS`` on a terminal of ``width`` characters; killed at the end if it still runs."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    command = [sys.executable, "-m", module, *arguments]
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SURROGYM_")}
    environment = kept | {"TERM": "xterm", "COLUMNS": str(width)}
    process = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, cwd=folder, preexec_fn=_heed_interrupts
    )
    os.close(theirs)
    try:
        yield Terminal(process, ours)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        os.close(ours)
