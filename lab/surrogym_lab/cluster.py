"""Cells of studies as tasks of a Ray cluster. Each takes one CPU, on whatever machine has one free. A task gets the
files that it continues from and gives back those that it wrote, so the machines need no common file system."""

from __future__ import annotations

import io
import platform
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from surrogym_client.runtime.versions import versions

Cell = TypeVar("Cell")
Result = TypeVar("Result")

RETRIES = 1  # of a task whose process or machine died
LOOK_SECONDS = 0.2
LONGEST_REASON = 300  # characters


class TaskFailed(Exception):
    """The work raised an exception, or its process or machine died. ``str(error)`` is one line."""


@dataclass(frozen=True)
class _Ran:
    """What a task left: a result or the reason why there is none, and its folder as a zip archive."""

    result: Any
    reason: str
    archive: bytes = field(repr=False)


class Task(Generic[Result]):
    """Work that runs in the cluster that this process is connected to.

    Args:
        work: function of a folder in which it writes its files. It pickles.
        folder: folder of this machine that these files come to.
        sent: a path below ``folder``. What is there now is in the work's folder from the start.
    """

    def __init__(self, work: Callable[[Path], Result], folder: Path, sent: str | None = None) -> None:
        import ray

        self._ray: Any = ray
        self._folder = folder
        begun = b"" if sent is None else _packed(folder, sent)
        # A process of its own: it leaves no thread count, cache or imported module to the next task.
        remote: Any = ray.remote(num_cpus=1, max_retries=RETRIES, max_calls=1)(_there)
        self._asked = remote.remote(work, begun, versions())

    @property
    def over(self) -> bool:
        """Whether it has ended, well or not."""
        done, _ = self._ray.wait([self._asked], timeout=0)
        return bool(done)

    def result(self) -> Result:
        """Wait for the end, put the files into the folder, and return the result.

        Raises:
            TaskFailed: there is none. What the work had written by then is in the folder, unless its process died.
        """
        try:
            ran: _Ran = self._ray.get(self._asked)
        except self._ray.exceptions.RayError as error:
            last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            raised = isinstance(error, self._ray.exceptions.RayTaskError)
            raise TaskFailed(last if raised else f"the process or machine of the run died: {last}") from error
        _unpack(ran.archive, self._folder)
        if ran.reason:
            raise TaskFailed(ran.reason)
        result: Result = ran.result
        return result

    def end(self) -> None:
        """End its process. What it wrote is lost."""
        with suppress(self._ray.exceptions.RayError, ValueError):
            self._ray.cancel(self._asked, force=True)


def run_tasks(
    todo: Sequence[Cell],
    begin: Callable[[Cell], Task[Result]],
    jobs: int,
    ended: Callable[[Cell, Task[Result]], None],
) -> None:
    """Run a task for each cell, ``jobs`` at once. ``ended`` is called when one is over. An interruption ends the tasks
    that run."""
    waiting, running = list(todo), list[tuple[Cell, Task[Result]]]()
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running.append((waiting[0], begin(waiting[0])))
                del waiting[0]
            for cell, task in [pair for pair in running if pair[1].over]:
                running.remove((cell, task))
                ended(cell, task)
            time.sleep(LOOK_SECONDS)
    finally:
        for _, task in running:
            task.end()


def _there(work: Callable[[Path], Any], begun: bytes, expected: Mapping[str, str]) -> _Ran:
    """Do the work in a process of the cluster. Its versions must be the expected ones."""
    here = versions()
    for name, wanted in expected.items():
        if (got := here.get(name, "none")) != wanted:
            where = f"got {got} on {platform.node()}"
            return _Ran(None, f"expected {name} {wanted} on every machine of the cluster, {where}", b"")
    with tempfile.TemporaryDirectory(prefix="surrogym-") as name:
        folder, result, reason = Path(name), None, ""
        _unpack(begun, folder)
        try:
            result = work(folder)
        except Exception as error:  # what it wrote so far goes back with it
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"[:LONGEST_REASON]
        return _Ran(result, reason, _packed(folder, "."))


def _packed(folder: Path, part: str) -> bytes:
    """A part of a folder as a zip archive; empty if it does not exist."""
    archive, begin = io.BytesIO(), folder / part
    if begin.exists():
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
            for path in (begin, *begin.rglob("*")):
                if path != folder:
                    packed.write(path, path.relative_to(folder))
    return archive.getvalue()


def _unpack(archive: bytes, folder: Path) -> None:
    """Write an archive's files below the folder; ``zipfile`` keeps them there, whatever their names are."""
    if archive:
        with zipfile.ZipFile(io.BytesIO(archive)) as packed:
            packed.extractall(folder)
