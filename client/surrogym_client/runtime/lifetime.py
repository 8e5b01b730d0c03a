"""End a process together with its parent, and handle the signals that end it."""

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
    """Start a thread that ends this process as soon as its parent process has ended."""
    parent = os.getppid()
    threading.Thread(target=_watch, args=(parent,), name="exit-with-parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_SECONDS)
    os._exit(ORPHANED)


def terminations() -> list[signal.Signals]:
    """Return the signals that ask this process to end: SIGTERM and SIGHUP, without those that this process ignores,
    such as SIGHUP under nohup."""
    return [number for number in TERMINATIONS if signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """Context in which SIGTERM and SIGHUP raise KeyboardInterrupt, so that child processes are ended on exit."""

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
    """Context that delays Ctrl-C, SIGTERM and SIGHUP, so that they don't interrupt a step of a machine.

    A second signal is not delayed. Signals without a Python handler, and threads other than the main one, are not
    affected.

    Yields:
        a function to call between two steps, which handles a signal that was delayed.
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
