"""Output of commands: results on standard output, everything else on standard error."""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import typer

from surrogym_shared.words import visible

PLAIN_SECONDS = 5.0  # time between two lines of progress, if the output is no terminal that can show a bar
FIRST_SECONDS = 2.0  # time before the first line of progress, so that work that ends sooner shows none
WATCH_SECONDS = 1.0  # time between two updates of a watched output

# Arguments: share of the work that is done, in [0, 1] (None: unchanged), and a short description.
Update = Callable[[float | None, str], None]


def say(text: str, *, quiet: bool = False) -> None:
    """Print a remark for a person on standard error."""
    if not quiet:
        typer.echo(visible(text), err=True)


def give(result: dict[str, Any], text: Callable[[], str], *, as_json: bool, quiet: bool = False) -> None:
    """Print the result of a command on standard output, as JSON or as text. ``quiet`` suppresses the text."""
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    elif not quiet:
        typer.echo(visible(text()))


def watch(look: Callable[[], str], seconds: float = WATCH_SECONDS) -> None:
    """Show the text that ``look`` returns until Ctrl-C, and update it every ``seconds``: in place on a terminal,
    elsewhere as further text if it has changed."""
    with suppress(KeyboardInterrupt), _screen() as show:
        while True:
            show(look())
            time.sleep(seconds)


@contextmanager
def _screen() -> Iterator[Callable[[str], None]]:
    if not sys.stdout.isatty():
        last: list[str] = []

        def show(text: str) -> None:
            if last[-1:] != [text]:
                last[:] = [text]
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
    """Context that delays Ctrl-C until its end, so that the output in it is drawn completely."""
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
    """Context that prints ``words`` after Ctrl-C, such as what was saved, and raises ``KeyboardInterrupt`` again."""
    try:
        yield
    except KeyboardInterrupt:
        if sys.stderr.isatty():
            typer.echo(err=True)  # begin a new line, because the terminal has written ^C to the present one
        say(words())
        raise


@contextmanager
def progress(title: str, *, quiet: bool = False) -> Iterator[Update]:
    """Context that shows the progress of work: a bar on a terminal; elsewhere lines, the first after ``FIRST_SECONDS``
    seconds; nothing if ``quiet``. Yields the function that updates it."""
    if quiet:
        yield _silent
    elif sys.stderr.isatty():
        with _bar(title) as update:
            yield update
    else:
        lines, ended = _Lines(title), threading.Event()
        threading.Thread(target=lines.show_until, args=(ended,), daemon=True).start()
        try:
            yield lines
        finally:
            ended.set()


@contextmanager
def _bar(title: str) -> Iterator[Update]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    class Words(ProgressColumn):
        """What is done. Of the columns, a narrow terminal cuts off only this one, which may wrap as far as it knows."""

        def render(self, task: Task) -> Text:
            return Text(task.fields["words"], no_wrap=True, overflow="ellipsis")

    class Elapsed(ProgressColumn):
        """The duration so far. It goes on when the bar is full: an audit may follow."""

        def render(self, task: Task) -> Text:
            return Text(str(timedelta(seconds=int(task.elapsed or 0))), style="progress.elapsed")

    console, whole = Console(stderr=True), Column(no_wrap=True)
    parts = (
        TextColumn("{task.description:<10}"),
        BarColumn(min(24, console.width // 4), table_column=whole),
        Words(Column()),
        Elapsed(whole),
    )
    with Progress(*parts, console=console) as bar:
        task = bar.add_task(title, total=1.0, words="")
        yield lambda share, words: bar.update(task, completed=share, words=words)


class _Lines:
    """Progress as lines of text, at most one in ``PLAIN_SECONDS`` seconds. The end of the work (share 1) is always
    shown, and so are words that nothing follows for that long."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._next = time.monotonic() + FIRST_SECONDS
        self._lock = threading.Lock()
        self._words = self._last = ""

    def __call__(self, share: float | None, words: str) -> None:
        self._words = words
        if time.monotonic() >= self._next or (share or 0.0) >= 1.0:
            self._show()

    def show_until(self, ended: threading.Event) -> None:
        """Show the words that came too soon after a line, until the work has ended. This runs in another thread."""
        while not ended.wait(max(0.0, self._next - time.monotonic())):
            self._show()

    def _show(self) -> None:
        with self._lock:
            if self._words != self._last:
                self._last = self._words
                say(f"{self._title}: {self._words}")
            self._next = time.monotonic() + PLAIN_SECONDS


def _silent(share: float | None, words: str) -> None:
    del share, words
