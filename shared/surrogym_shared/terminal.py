"""How commands speak: the result on standard output, everything else on standard error."""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import typer

PLAIN_SECONDS = 5.0  # between lines of progress where no bar can be drawn
FIRST_SECONDS = 2.0  # before the first of them: what is over by then, or refused, needs none
WATCH_SECONDS = 1.0  # between looks at what is watched

Update = Callable[[float | None, str], None]  # share done in [0, 1], None for as before; a few words


_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}


def visible(text: str) -> str:
    """The text with control characters written out: names and errors of others must not steer a terminal."""
    return text.translate(_CONTROLS)


def say(text: str, *, quiet: bool = False) -> None:
    """A remark for the person, on standard error."""
    if not quiet:
        typer.echo(visible(text), err=True)


def give(result: dict[str, Any], text: Callable[[], str], *, as_json: bool, quiet: bool = False) -> None:
    """The result, on standard output: as JSON, or in words; ``quiet`` leaves out words that are a mere remark."""
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    elif not quiet:
        typer.echo(visible(text()))


def watch(look: Callable[[], str], seconds: float = WATCH_SECONDS) -> None:
    """Show what ``look`` says until Ctrl-C: in place on a terminal, elsewhere anew whenever it has changed."""
    with suppress(KeyboardInterrupt), _screen() as show:
        while True:
            show(look())
            time.sleep(seconds)


@contextmanager
def _screen() -> Iterator[Callable[[str], None]]:
    if not sys.stdout.isatty():
        shown: list[str] = []

        def show(text: str) -> None:
            if shown[-1:] != [text]:
                shown[:] = [text]
                typer.echo(visible(text))

        yield show
        return
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False) as live:

        def draw(text: str) -> None:
            with _interrupt_afterwards():
                live.update(Text(visible(text)), refresh=True)

        yield draw


@contextmanager
def _interrupt_afterwards() -> Iterator[None]:
    """Let Ctrl-C wait for the end of what is within: half a drawing would be drawn again below itself."""
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt


@contextmanager
def on_interrupt(words: Callable[[], str]) -> Iterator[None]:
    """Say after Ctrl-C what was saved and how to go on; the interruption goes on."""
    try:
        yield
    except KeyboardInterrupt:
        say(words())
        raise


@contextmanager
def progress(title: str, *, quiet: bool = False) -> Iterator[Update]:
    """A bar on a terminal, plain lines elsewhere for what takes longer than ``FIRST_SECONDS``, nothing when quiet."""
    if quiet:
        yield _silent
    elif sys.stderr.isatty():
        with _bar(title) as update:
            yield update
    else:
        lines = _Lines(title)
        first = threading.Timer(FIRST_SECONDS, lines.begin)
        first.daemon = True
        first.start()
        try:
            yield lines
        finally:
            first.cancel()


@contextmanager
def _bar(title: str) -> Iterator[Update]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    parts = (
        TextColumn("{task.description:<10}"),
        BarColumn(24),
        TextColumn("{task.fields[words]}"),
        TimeElapsedColumn(),
    )
    with Progress(*parts, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=1.0, words="")
        yield lambda share, words: bar.update(task, completed=share, words=words)


class _Lines:
    """Progress as lines, not too many of them, and none before ``begin``; the end is said in any case."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._next = math.inf
        self._words = self._last = ""

    def __call__(self, share: float | None, words: str) -> None:
        self._words = words
        if time.monotonic() >= self._next or (share or 0.0) >= 1.0:
            self.begin()

    def begin(self) -> None:
        """Say what is known by now; the first time from another thread."""
        if self._words != self._last:
            self._last = self._words
            say(f"{self._title}: {self._words}")
        self._next = time.monotonic() + PLAIN_SECONDS


def _silent(share: float | None, words: str) -> None:
    del share, words
