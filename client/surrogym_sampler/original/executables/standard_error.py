"""The standard error of a program: it is passed on to that of this process, and the last line is kept for errors."""

from __future__ import annotations

import os
import select
import threading
from typing import IO

OWN = 2  # file descriptor of this process's standard error
TAIL = 4096  # number of last bytes of the program's standard error that are kept
SHOWN = 200  # largest number of characters of the last line in an error
PATIENCE = 0.1  # a piece of output is dropped if this process's standard error does not accept it within these seconds
LAST_SECONDS = 1.0  # seconds to read the output of an ended program; a process that it started may hold the pipe open


class StandardError:
    """The standard error of a running program. A thread reads it, so that the program never waits for a reader.

    A piece that this process's own standard error does not accept in time is dropped.

    Args:
        pipe: the end of the pipe to read from. The thread closes it.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._tail = b""
        self._thread = threading.Thread(target=self._pass_on, name="standard error", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Wait until the output of an ended program is read, at most ``LAST_SECONDS``."""
        self._thread.join(LAST_SECONDS)

    def last_line(self) -> str:
        """Return the printable characters of the last line that is not empty; "" if there is none."""
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
    """Write to this process's standard error, and return whether it accepted the piece within ``seconds``. A pipe that
    is ready accepts ``PIPE_BUF`` bytes without waiting."""
    try:
        ready = bool(select.select([], [OWN], [], seconds)[1])
        return ready and os.write(OWN, piece) > 0
    except OSError:  # this process's standard error is closed
        return False
