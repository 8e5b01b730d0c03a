"""How a process ends: with the one that started it, so that a killed parent leaves nothing behind, and in order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

LOOK_SECONDS = 0.5
ORPHANED = 1
TERMINATIONS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


def exit_with_parent() -> None:
    """Watch the parent from a thread; when it is gone, end this process at once."""
    parent = os.getppid()
    threading.Thread(target=_watch, args=(parent,), name="exit-with-parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_SECONDS)
    os._exit(ORPHANED)


def terminations() -> list[signal.Signals]:
    """The signals of a polite kill and of a closed terminal, but those that are ignored, as nohup asks."""
    return [number for number in TERMINATIONS if signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """A polite kill is taken like Ctrl-C, so that the children are ended on the way out."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in terminations()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def signals_between_steps() -> Iterator[Callable[[], None]]:
    """Hold back Ctrl-C, and the other signals that ask this process to end, while a machine moves. The second signal in
    a row is not held back. What is ignored, ends the process at once, or comes outside the main thread stays as it is.

    Yields:
        what to call between two steps: it does what a signal that was held back asks for.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    handlers = {
        number: handler for number in (signal.SIGINT, *TERMINATIONS) if callable(handler := signal.getsignal(number))
    }
    held: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        held.append(number)
        if len(held) > 1:
            heed(frame)

    def heed(frame: FrameType | None = None) -> None:
        if held:
            number = held[-1]
            held.clear()
            handlers[number](number, frame)

    for number in handlers:
        signal.signal(number, hold)
    try:
        yield heed
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    heed()
