"""Fits run in one process of their own, so that steps never wait for them."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from threading import Thread

from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.errors import PluginFailed, Unavailable
from surrogym_shared.plugins import one_line

NICENESS = 10  # to a step on the same core a fit leaves nine tenths of it


class Fits:
    """A pool of one process. It ends with this one, however this one ends.

    The process holds one end of a pipe whose other end is here and never written: when ours closes by death, it ends
    at once, in the middle of a fit too.
    """

    def __init__(self, function: Callable[[DesignJob], DesignResult] = run_design_job) -> None:
        self._function = function
        self._pool: ProcessPoolExecutor | None = None
        self._lifeline: Connection | None = None
        self._processes: list[BaseProcess] = []

    def start(self) -> None:
        """Start the process, and let it import what a fit needs before the first one comes."""
        context = get_context("spawn")
        theirs, self._lifeline = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=_live_with, initargs=(theirs,))
        others = active_children()
        with _terminal_blocked(), theirs:
            self._pool.submit(_warm)
        self._processes = [child for child in active_children() if child not in others]

    async def run(self, job: DesignJob) -> DesignResult:
        """Do a job; a process that died is replaced and the job done once more.

        Raises:
            Unavailable: the process died twice.
            PluginFailed: code of a package asked to exit; that must not end this process.
            Exception: whatever the job raises.
        """
        for _ in range(2):
            if self._pool is None:
                self.start()
            assert self._pool is not None
            try:
                return await asyncio.wrap_future(self._pool.submit(self._function, job))
            except BrokenProcessPool:
                pass
            except SystemExit as error:
                raise PluginFailed(f"the fit failed: a package called sys.exit: {one_line(error)}") from error
            self.close()
        raise Unavailable("the process that fits died twice on the same job: is there enough memory?")

    def close(self) -> None:
        """End the process, in the middle of a fit or of its start too; harmless when it has ended."""
        for process in self._processes:
            process.kill()
        if self._lifeline is not None:
            self._lifeline.close()
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        self._lifeline = self._pool = None
        self._processes = []


@contextmanager
def _terminal_blocked() -> Iterator[None]:
    """Block what a terminal sends to all its processes, by Ctrl-C or when it closes, for those started within: they
    inherit the mask; this one takes its signals afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _live_with(lifeline: Connection) -> None:
    os.nice(NICENESS)
    Thread(target=_exit_when_closed, args=(lifeline,), daemon=True).start()


def _exit_when_closed(lifeline: Connection) -> None:
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(0)


def _warm() -> None:
    import surrogym_server.models.registry  # noqa: F401
