"""Fits in child processes, so that steps never wait for a fit, and so that a fit can be stopped."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from threading import Lock, Thread
from typing import Literal

from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.port import Compute
from surrogym_server.errors import ChoiceFailed, PluginFailed, SurrogymError, Unavailable
from surrogym_server.plugins import in_one_line

# Fits run in processes with this nice value (low priority). A step that shares a core with a fit then gets nine tenths
# of the core's time.
NICENESS = 10
Function = Callable[[DesignJob], DesignResult]


@dataclass(frozen=True)
class Failure:
    """Error of a job as text. The exception itself might not pickle, or might end the process that receives it."""

    kind: type[PluginFailed]
    message: str
    details: str  # traceback of the error if it was unexpected, otherwise empty


class Fits(Compute):
    """Runs each fit in a child process. The child processes end when this process ends, even by a crash.

    Args:
        function: computes a job.
        idle: number of idle child processes to keep for the next jobs.
        forks: whether the first child is a fork of this process, on Linux. A fork saves about three seconds of imports.
            It is safe only while this process has no other Python thread and no open connection.
    """

    def __init__(self, function: Function = run_design_job, idle: int = 1, *, forks: bool = False) -> None:
        self._function = function
        self._most_idle = idle
        self._forks = forks and sys.platform == "linux"
        self._idle: list[_Process] = []
        self._busy: list[_Process] = []

    def start(self) -> None:
        """Start a child process, so that the first fit need not wait for it. Does nothing if an idle one exists."""
        if not self._idle:
            self._idle.append(_Process("fork" if self._forks else "spawn"))

    async def run(self, job: DesignJob) -> DesignResult:
        """Run a job in a child process, and once more in a new one if the process dies.

        Raises the errors of ``Compute.run``.
        """
        for _ in range(2):
            process = self._idle.pop() if self._idle else _Process()
            self._busy.append(process)
            whole = False
            try:
                outcome = await asyncio.wrap_future(process.pool.submit(done, self._function, job))
                whole = True
            except BrokenProcessPool:
                continue
            except Exception as error:  # errors of the job come back as ``Failure``: here its result can't be pickled
                raise PluginFailed(in_one_line(error)) from error
            finally:
                self._give_back(process, whole)
            if isinstance(outcome, Failure):
                raise error_of(outcome)
            return outcome
        raise Unavailable(
            "expected the process that fits the model to end normally, but it died twice, perhaps because the machine "
            "has too little memory: free memory, then try again"
        )

    def close(self) -> None:
        """Kill all child processes, also those that start or run a fit. Does nothing if they have ended."""
        for process in (*self._idle, *self._busy):
            process.close()
        self._idle = []

    def _give_back(self, process: _Process, whole: bool) -> None:
        """Keep a child process for the next fit, or end it. It is ended if enough processes are idle, or if its last
        job was interrupted (``whole`` is False)."""
        self._busy.remove(process)
        if whole and len(self._idle) < self._most_idle:
            self._idle.append(process)
        else:
            process.close()


class _Process:
    """One child process for fits, which ends when its parent process ends.

    The child waits to read from a pipe that the parent holds open and never writes to. When the parent dies, the pipe
    closes, and the child exits at once, even in the middle of a fit.
    """

    def __init__(self, method: Literal["fork", "spawn"] = "spawn") -> None:
        context = get_context(method)
        theirs, self._lifeline = context.Pipe(duplex=False)
        # A forked child inherits the parent's end of the pipe. It must close it, or the pipe stays open when the parent
        # dies.
        ours = self._lifeline if method == "fork" else None
        self.pool = ProcessPoolExecutor(1, mp_context=context, initializer=_live_with, initargs=(theirs, ours))
        self._closing = Lock()
        others = active_children()
        with _terminal_blocked(), theirs:
            self.pool.submit(_warm)
        self._processes: list[BaseProcess] = [child for child in active_children() if child not in others]

    def close(self) -> None:
        """Kill the child process, even while it runs a job. Does nothing if it has ended. Thread-safe."""
        with self._closing:
            for process in self._processes:
                process.kill()
            self._processes = []
            self._lifeline.close()
            self.pool.shutdown(wait=True, cancel_futures=True)


def done(function: Function, job: DesignJob) -> DesignResult | Failure:
    """Compute a job in a child process. Return any exception as a ``Failure``, even one that would end the process."""
    try:
        return function(job)
    except BaseException as error:
        on_purpose = isinstance(error, SurrogymError) and error.__cause__ is None
        kind = ChoiceFailed if isinstance(error, ChoiceFailed) else PluginFailed
        return Failure(kind, in_one_line(error), "" if on_purpose else traceback.format_exc())


def error_of(outcome: Failure) -> PluginFailed:
    """Convert a ``Failure`` back to an exception, with the traceback as a note."""
    failure = outcome.kind(outcome.message)
    if outcome.details:
        failure.add_note(outcome.details)
    return failure


@contextmanager
def _terminal_blocked() -> Iterator[None]:
    """Return a context in which SIGINT and SIGHUP, the signals of a terminal, are blocked. Child processes that start
    in it keep these signals blocked.

    If one of these signals arrives meanwhile, this process receives it when the context ends.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _live_with(lifeline: Connection, others_end: Connection | None) -> None:
    if others_end is not None:
        others_end.close()
    gc.enable()  # the parent process may have disabled garbage collection, and a forked child inherits that
    os.nice(NICENESS)
    Thread(target=_exit_when_closed, args=(lifeline,), daemon=True).start()


def _exit_when_closed(lifeline: Connection) -> None:
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(0)


def _warm() -> None:
    import scipy.linalg.lapack
    import scipy.optimize
    import scipy.spatial.distance  # noqa: F401

    import surrogym_server.models.registry  # noqa: F401
