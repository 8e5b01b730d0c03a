"""An original environment in its own process: one that raises or hangs costs a query, not the worker."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Self

from surrogym_client.original.errors import EnvironmentDied, StepFailed, StepTimedOut, UnknownEnvironment, sentence
from surrogym_client.original.protocol import Array, Environment, Factory, RealStep
from surrogym_client.original.rollouts import answering
from surrogym_shared.spec import EnvironmentSpec

START_LIMIT = 120.0  # seconds; importing a simulator may take long
CLOSE_LIMIT = 2.0


class IsolatedEnvironment:
    """An environment whose steps run in a child process, each within a time limit; so does a reset.

    After a step that hung or a process that died, the next step starts a fresh environment.

    Args:
        factory: makes the environment in the child; it has to pickle (a module's function, a ``partial``).
        step_limit: seconds one step may take.

    Raises (from any method):
        UnknownEnvironment: the factory failed.
        StepFailed: the environment raised, hung or died; the message says which.
    """

    def __init__(self, factory: Factory, step_limit: float = 30.0) -> None:
        self._factory = factory
        self._step_limit = step_limit
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None

    def spec(self) -> EnvironmentSpec:
        return EnvironmentSpec.model_validate(self._ask("spec", (), self._step_limit))

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        step: RealStep = self._ask("step_from", (coordinates, action), self._step_limit)
        return step

    def begin(self, seed: int | None = None) -> Array:
        start: Array = self._ask("begin", (seed,), self._step_limit)
        return start

    def act(self, action: Array) -> RealStep:
        step: RealStep = self._ask("act", (action,), self._step_limit)
        return step

    def close(self) -> None:
        """Let the environment close; one that doesn't is killed."""
        if self._pipe is not None and self._process is not None and self._process.is_alive():
            with suppress(StepFailed):
                self._ask("close", (), CLOSE_LIMIT)
        self._kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, method: str, arguments: tuple[Any, ...], limit: float) -> Any:
        pipe = self._start()
        try:
            pipe.send((method, arguments))
            if not pipe.poll(limit):
                self._kill()
                raise StepTimedOut(f"{method} took longer than {limit:g} s and was killed")
            ok, value = pipe.recv()
        except (EOFError, OSError) as error:
            code = self._kill()
            raise EnvironmentDied(f"the environment's process ended with exit code {code} in {method}") from error
        if not ok:
            raise StepFailed(value)
        return value

    def _start(self) -> Connection:
        if self._pipe is not None and self._process is not None and self._process.is_alive():
            return self._pipe
        self._kill()
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._factory), daemon=True)
        self._process.start()
        theirs.close()
        self._await_start(self._pipe)
        return self._pipe

    def _await_start(self, pipe: Connection) -> None:
        try:
            if not pipe.poll(START_LIMIT):
                raise StepTimedOut(f"the environment took longer than {START_LIMIT:g} s to start")
            ok, value = pipe.recv()
        except EOFError as error:
            raise EnvironmentDied(f"the environment's process ended with exit code {self._kill()}") from error
        if not ok:
            self._kill()
            raise UnknownEnvironment(value)

    def _kill(self) -> int | None:
        process, self._process = self._process, None
        pipe, self._pipe = self._pipe, None
        if pipe is not None:
            pipe.close()
        if process is None:
            return None
        process.join(0.1)
        if process.is_alive():
            process.kill()
            process.join()
        return process.exitcode


def _serve(pipe: Connection, factory: Factory) -> None:
    """The child: one answer (ok, value) for the start, then one for every request."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        environment = answering(factory())
    except Exception as error:
        pipe.send((False, sentence(error)))
        return
    pipe.send((True, None))
    while True:
        try:
            method, arguments = pipe.recv()
        except EOFError:
            return
        pipe.send(_answer(environment, method, arguments))


def _answer(environment: Environment, method: str, arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    try:
        value = getattr(environment, method)(*arguments)
        return True, value.model_dump() if isinstance(value, EnvironmentSpec) else value
    except Exception as error:
        return False, sentence(error)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
