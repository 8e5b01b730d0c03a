"""Cells of the study in processes of this machine, which end with the one that started them."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path

from surrogym_client.runtime.lifetime import exit_with_parent
from surrogym_lab.peers.points import Point
from surrogym_lab.peers.study import PeerCell, begun, run_cell
from surrogym_lab.reproduce.rows import write_records

ENDING_SECONDS = 5.0

AfterRound = Callable[[PeerCell, Point], None]


def run_cells(
    todo: Sequence[PeerCell],
    folder: Path,
    jobs: int,
    tell: Callable[[PeerCell, list[Point]], None],
    after_round: AfterRound = lambda *_: None,
) -> None:
    """Run cells, ``jobs`` at once, each in a process of its own with one thread. ``tell`` is called after each cell,
    and ``after_round`` after each round.

    A cell whose process died has a point with the reason. An interruption or an error ends the cells that run; what
    they have written stays."""
    waiting, running = list(reversed(todo)), dict[Connection, _Child]()
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                child = _Child(waiting.pop(), folder)
                running[child.pipe] = child
            for pipe in wait(list(running)):
                assert isinstance(pipe, Connection)
                child = running[pipe]
                said = child.said()
                if isinstance(said, Point):
                    after_round(child.cell, said)
                else:
                    running.pop(pipe).finish()
                    tell(child.cell, said)
    finally:
        for child in running.values():
            child.end()


class _Child:
    """The process of a cell. ``pipe`` has something to read after each round and at the end."""

    def __init__(self, cell: PeerCell, folder: Path) -> None:
        context = get_context("spawn")  # a fork would inherit threads
        self.cell = cell
        self._folder = folder
        self.pipe, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(theirs, cell, folder))
        with _without_interrupt():
            self._process.start()
        theirs.close()

    def said(self) -> Point | list[Point]:
        """The point of a round, or all points at the end. Raises what ended the cell, unless its points say it."""
        try:
            said: Point | list[Point] | Exception = self.pipe.recv()
        except EOFError:
            return self._died()
        if isinstance(said, Exception):
            raise said
        return said

    def finish(self) -> None:
        """Let the process close its environment, and make sure of its end."""
        self._process.join(ENDING_SECONDS)
        self.end()

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.terminate()
        self._process.join(ENDING_SECONDS)
        self._process.kill()
        self._process.join()
        self.pipe.close()

    def _died(self) -> list[Point]:
        self._process.join()
        points = self.cell.points(self._folder)
        reason = f"RuntimeError: its process ended with exit code {self._process.exitcode}"
        points.append(replace(points[-1] if points else begun(self.cell), ended=reason))
        write_records(self.cell.file(self._folder), Point, points)
        return points


def _work(pipe: Connection, cell: PeerCell, folder: Path) -> None:
    exit_with_parent()
    if (parent := parent_process()) is not None and not parent.is_alive():  # it was killed before the watch began
        return
    with suppress(BrokenPipeError):  # the parent is gone
        try:
            pipe.send(run_cell(cell, folder, pipe.send))
        except BrokenPipeError:
            raise
        except Exception as error:
            error.add_note(traceback.format_exc())  # which does not pickle otherwise
            pipe.send(error)


@contextmanager
def _without_interrupt() -> Iterator[None]:
    """A process that starts inside never gets Ctrl-C, which is for its parent to heed. This one gets it afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
