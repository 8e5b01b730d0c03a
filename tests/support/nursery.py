"""Start servers as forks of a process that has imported them already.

A server imports torch, FastAPI and SQLAlchemy, and the process of its fits does so again: some nine seconds of a core
for each of a hundred servers. Tests of what a start does start their server cold. The process that is forked is one
for all workers of a run.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import runpy
import select
import selectors
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from multiprocessing import context, forkserver, resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import torch
from threadpoolctl import threadpool_limits

MODULES = (
    "surrogym_server.cli.runner",
    "surrogym_server.cli.serve",
    "surrogym_server.models.gaussian_process.prediction.compiled.regions",
    "surrogym_server.models.gaussian_process.prediction.compiled.step",
    "surrogym_server.models.registry",
    "surrogym_server.virtual.compiled.step",
    "surrogym_server.virtual.words",
    "scipy.linalg.lapack",
    "scipy.optimize",
    "scipy.spatial.distance",
    "uvicorn.lifespan.on",
)
SAMPLING = (
    "gymnasium.envs.classic_control",
    "surrogym_sampler.original.gymnasium",
    "surrogym_sampler.original.isolated",
    "surrogym_sampler.queries",
)
# Variables that modules read when they are imported, or their beginnings.
READ_EARLY = ("CUDA_", "HOME", "LD_", "MKL_", "NUMBA_", "OMP_", "OPENBLAS_", "PYTHON", "SURROGYM_COMPILED", "XDG_")
LONGEST = 1 << 18  # bytes of a request

forkserver.set_forkserver_preload([*MODULES, *SAMPLING])
CONTEXTS: dict[str, Any] = context._concrete_contexts  # type: ignore[attr-defined]
FORKS = sys.platform == "linux"  # elsewhere forks are not safe
FORKSERVER: Any = forkserver._forkserver  # type: ignore[attr-defined]


class Forked:
    """A forked program, with what tests use of ``subprocess.Popen``."""

    def __init__(self, pid: int, status: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._status = status

    def __del__(self) -> None:
        os.close(self._status)

    def poll(self) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            self.returncode = int(os.read(self._status, 100) or -signal.SIGKILL)  # nothing: the nursery has died
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Nursery:
    """A process that forks servers. It is a fork itself, of the process that forks fits. It ends with this process,
    and its children with it."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._asked, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._asked.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LONGEST)
        with theirs:
            self._process = CONTEXTS["forkserver"].Process(target=main, args=(theirs, _search_path()))
            self._process.start()
        atexit.register(self._end)

    def start(self, arguments: Sequence[str], log: IO[bytes], environment: Mapping[str, str], folder: Path) -> Forked:
        """Run ``python -m surrogym_server ARGUMENTS`` in a folder, with its output in ``log``."""
        os.umask(umask := os.umask(0o077))
        request = {
            "arguments": arguments,
            "environment": dict(environment),
            "folder": str(folder),
            "umask": umask,
        }
        status, theirs = os.pipe()
        with self._turn:
            socket.send_fds(self._asked, [json.dumps(request).encode()], [log.fileno(), theirs])
            pid = int(self._asked.recv(100))
        os.close(theirs)
        return Forked(pid, status)

    def _end(self) -> None:
        self._asked.close()
        self._process.join()


def _search_path() -> list[str]:
    """Where a program finds modules that runs outside of any folder."""
    listed = subprocess.run(
        [sys.executable, "-P", "-c", "import sys; print(*sys.path, sep='\\n')"],
        capture_output=True,
        text=True,
        check=True,
    )
    return listed.stdout.splitlines()


def reads_early(environment: Mapping[str, str]) -> bool:
    """Whether imported modules have read one of these variables, so that they have to be imported anew.

    Folders of ``PYTHONPATH`` hold packages that a server looks for later.
    """
    return any(name.startswith(READ_EARLY) for name in environment if name != "PYTHONPATH")


def one_thread() -> None:
    """Let libraries compute in one thread each. Small matrices gain nothing from more, and threads that wait for each
    other wait by spinning: on cores that others use as well, for much longer than they compute."""
    torch.set_num_threads(1)
    threadpool_limits(1)


def share() -> str:
    """Start the process that is forked, for all workers of this run. It compiles what is not compiled yet. Returns its
    address."""
    kept = [os.dup(stream) for stream in (1, 2)]
    with open(os.devnull, "wb") as nowhere:
        for stream in (1, 2):
            os.dup2(nowhere.fileno(), stream)  # what forks print is no part of a run's report
    try:
        forkserver.ensure_running()
    finally:
        for stream, before in zip((1, 2), kept, strict=True):
            os.dup2(before, stream)
            os.close(before)
    return str(FORKSERVER._forkserver_address)


def await_shared() -> None:
    """Wait until the process that is forked has imported everything."""
    first = CONTEXTS["forkserver"].Process(target=os.getpid)
    first.start()
    first.join()


def use_shared(address: str) -> None:
    """Fork the process that the controller of this run has started, and that ends with it."""
    FORKSERVER._forkserver_address = address
    _, FORKSERVER._forkserver_alive_fd = os.pipe()  # forks inherit it; it keeps nothing alive here
    FORKSERVER.ensure_running = resource_tracker.ensure_running


@cache
def nursery() -> Nursery | None:
    """The nursery of this process, None on a system where forks are not safe."""
    return Nursery() if FORKS else None


def main(asked: socket.socket, path: list[str]) -> None:
    """Fork a child for each request, until the socket closes.

    Args:
        asked: its other end sends the requests.
        path: where servers look for modules; not where tests do.
    """
    from surrogym_server.storage.sql import open_storage  # here: a fork of this process has imported it already

    sys.path[:] = path
    FORKSERVER.ensure_running = lambda: None  # the one this is a fork of
    context._concrete_contexts = CONTEXTS | {"spawn": CONTEXTS["forkserver"]}  # type: ignore[attr-defined]
    with TemporaryDirectory() as folder:
        open_storage(f"sqlite:///{folder}/surrogym.db").close()  # it imports, and compiles statements, at its first use
    one_thread()
    gc.freeze()
    children: dict[int, tuple[int, int]] = {}  # by a descriptor that is readable at its end: its process, its status
    with selectors.DefaultSelector() as waiting:
        waiting.register(asked, selectors.EVENT_READ)
        while True:
            for key, _ in waiting.select():
                if key.fd in children:
                    waiting.unregister(key.fd)
                    _tell(key.fd, *children.pop(key.fd))
                    continue
                message, descriptors, _, _ = socket.recv_fds(asked, LONGEST, 2)
                if not message:
                    for pid, _ in children.values():
                        os.kill(pid, signal.SIGKILL)
                    return
                log, status = descriptors
                if not (pid := os.fork()):
                    for inherited in (status, *children, *(pipe for _, pipe in children.values())):
                        os.close(inherited)
                    _run(log, **json.loads(message))
                    return
                os.close(log)
                children[end := os.pidfd_open(pid)] = pid, status
                waiting.register(end, selectors.EVENT_READ)
                asked.send(str(pid).encode())


class _Fork(context.ForkServerProcess):
    """A process with the variables of the environment that its parent has, not those of what it is a fork of."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._environment = dict(os.environ)

    def run(self) -> None:
        os.environ.clear()
        os.environ.update(self._environment)
        one_thread()
        super().run()


class _Forks(context.ForkServerContext):
    Process = _Fork  # type: ignore[assignment]


def contexts_of_forks() -> dict[str, Any]:
    """The ways of ``multiprocessing`` to start a process; "spawn" forks one that has imported what fits, environments
    and samplers need. That one starts with the first of its forks."""
    return {**CONTEXTS, "spawn": _Forks()} if FORKS else CONTEXTS


def _tell(end: int, pid: int, status: int) -> None:
    """Send the exit status of a child that has ended."""
    _, code = os.waitpid(pid, 0)
    with suppress(BrokenPipeError):
        os.write(status, str(os.waitstatus_to_exitcode(code)).encode())
    os.close(status)
    os.close(end)


def _run(log: int, arguments: list[str], environment: dict[str, str], folder: str, umask: int) -> None:
    os.umask(umask)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for stream in (1, 2):
        os.dup2(log, stream)
    os.close(log)
    sys.path[:0] = [folder, *filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))]
    sys.argv = ["surrogym_server", *arguments]
    runpy.run_module("surrogym_server", run_name="__main__", alter_sys=True)
