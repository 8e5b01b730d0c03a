"""What a program writes to its standard error: it is passed on, and the last line is kept for errors."""

from __future__ import annotations

import os
import select
import threading
from typing import IO

OWN = 2  # file descriptor of this process's standard error
TAIL = 4096  # bytes that are kept
SHOWN = 200  # characters of the last line that an error repeats
PATIENCE = 0.1  # seconds in which this process's standard error has to take a piece
LAST_SECONDS = 1.0  # until what an ended program wrote is read; a process that it left behind may hold the pipe


class StandardError:
    """The standard error of a running program. A thread reads it, so that the program never waits for a reader.

    A piece that this process's own standard error does not take in time is dropped.

    Args:
        pipe: its end to read from. The thread closes it.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._tail = b""
        self._thread = threading.Thread(target=self._pass_on, name="standard error", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Wait until everything is read that an ended program wrote, ``LAST_SECONDS`` at most."""
        self._thread.join(LAST_SECONDS)

    def last_line(self) -> str:
        """Return the last line that is not empty, with its printable characters alone; "" if there is none."""
        lines = self._tail.decode(errors="replace").splitlines()
        printable = ("".join(filter(str.isprintable, line)).strip() for line in reversed(lines))
        last = next(filter(None, printable), "")
        return last if len(last) <= SHOWN else f"{last[:SHOWN]}…"

    def _pass_on(self) -> None:
        taken = True
        with self._pipe:
            while piece := os.read(self._pipe.fileno(), select.PIPE_BUF):
                self._tail = (self._tail + piece)[-TAIL:]
                taken = _write(piece, PATIENCE if taken else 0.0)


def _write(piece: bytes, seconds: float) -> bool:
    """Write to this process's standard error; whether it took the piece. A pipe that is ready takes ``PIPE_BUF``
    bytes without waiting."""
    try:
        ready = bool(select.select([], [OWN], [], seconds)[1])
        return ready and os.write(OWN, piece) > 0
    except OSError:  # closed
        return False
