"""How a process ends: with the one that started it, so that a killed parent leaves nothing behind, and in order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

LOOK_SECONDS = 0.5
ORPHANED = 1


def exit_with_parent() -> None:
    """Watch the parent from a thread; when it is gone, end this process at once."""
    parent = os.getppid()
    threading.Thread(target=_watch, args=(parent,), name="exit-with-parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_SECONDS)
    os._exit(ORPHANED)


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """A polite kill is taken like Ctrl-C, so that the children are ended on the way out."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
