"""An original environment in its own process, so that an error or a hang fails one query and not the whole worker."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any, Self

from surrogym_sampler.original.errors import (
    MORE_TIME,
    RAISED,
    EnvironmentDied,
    FallbackFailed,
    StepFailed,
    StepRefused,
    StepTimedOut,
    UnknownEnvironment,
    sentence,
)
from surrogym_sampler.original.protocol import Array, Environment, Factory, RealStep, runs_in_parallel
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_shared.spec import EnvironmentSpec

START_LIMIT = 120.0  # seconds until the environment must be made; importing a simulator may take long
PARENTS_BUSINESS = (signal.SIGINT, getattr(signal, "SIGHUP", signal.SIGINT))
WITHIN_EPISODE = ("act", "save")  # requests that a new process can't answer, because its episode has not begun
CLOSE_LIMIT = 2.0  # seconds for closing the environment, in addition to the seconds that one step may take


class IsolatedEnvironment:
    """An environment whose steps and resets run in a child process, each within a time limit.

    After a step that hung, or a process that died, the next step starts a new environment. If this process ends, the
    child process finishes the running step, and closes the environment.

    Args:
        factory: makes the environment in the child process; it must be picklable (a module's function, a ``partial``).
        step_limit: seconds that one step may take.
        fallback: program of the fallback that the specification's limits name, as NAME=package.module:function. The
            child process imports it.

    Raises (from any method):
        UnknownEnvironment: the factory failed.
        StepFailed: the environment raised an error, hung or died; the message says which.
    """

    keeps_rates = True  # the environment in the child process keeps actions within the declared rates

    def __init__(self, factory: Factory, step_limit: float = 30.0, fallback: str | None = None) -> None:
        self._factory = factory
        self._fallback = fallback
        self._step_limit = step_limit
        self._number = 0  # number of the last request
        # Additional seconds for closing, in which the fallback controller brings the machine to rest.
        self._rest_seconds = 0.0
        self.parallel = False  # whether several instances may be open at once; known once the process has started
        self._fallback_steps = self._earlier_steps = 0  # fallback's steps in the running process, and in earlier ones
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None

    @property
    def fallback_steps(self) -> int:
        """Number of real steps that the fallback controller of the declared limits has taken while no query ran, up to
        the last request."""
        return self._earlier_steps + self._fallback_steps

    def spec(self) -> EnvironmentSpec:
        return EnvironmentSpec.model_validate(self._call("spec", (), self._step_limit))

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        step: RealStep = self._call("step_from", (coordinates, action), self._step_limit)
        return step

    def begin(self, seed: int | None = None) -> Array:
        start: Array = self._call("begin", (seed,), self._step_limit)
        return start

    def act(self, action: Array) -> RealStep:
        step: RealStep = self._call("act", (action,), self._step_limit)
        return step

    def save(self) -> bytes:
        snapshot: bytes = self._call("save", (), self._step_limit)
        return snapshot

    def restore(self, snapshot: bytes) -> Array:
        at: Array = self._call("restore", (snapshot,), self._step_limit)
        return at

    def close(self) -> None:
        """Let the environment finish its step and close. If that takes too long, or at Ctrl-C, its process is killed.

        If the specification has a fallback controller, Ctrl-C does not kill the process: the controller brings the
        machine to rest, then the process ends by itself.
        """
        try:
            if self._process is not None and not self._process.is_alive():
                self._count_last_steps()
            elif self._process is not None:
                with suppress(StepFailed):
                    self._call("close", (), self._step_limit + self._rest_seconds + CLOSE_LIMIT)
        except KeyboardInterrupt:
            if self._rest_seconds:
                self._process = None
            raise
        finally:
            self._kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _call(self, method: str, arguments: tuple[Any, ...], limit: float) -> Any:
        if method in WITHIN_EPISODE and self._process is not None and not self._process.is_alive():
            self._count_last_steps()
            code = self._kill()
            raise EnvironmentDied(
                f"the environment's process ended with exit code {code} before {method}: see what it printed"
            )
        pipe = self._start()
        self._number += 1
        try:
            pipe.send((self._number, method, arguments))
            answer = self._await_answer(pipe, limit)
        except (EOFError, OSError) as error:
            self._count_last_steps()
            code = self._kill()
            raise EnvironmentDied(
                f"the environment's process ended with exit code {code} during {method}: see what it printed"
            ) from error
        if answer is None:
            self._let_fall_back()
            self._kill()
            raise StepTimedOut(f"the environment's {method} took longer than {limit:g} s and was killed; {MORE_TIME}")
        ok, value = answer
        if isinstance(value, StepFailed):
            raise value
        if ok is None:
            self._await_end()
            self._kill()
            raise EnvironmentDied(
                f"the environment ended its process during {method}: {value}; let it raise an exception"
            )
        if not ok:
            raise StepFailed(value)
        return value

    def _let_fall_back(self) -> None:
        """If the specification has a fallback controller, give the step that takes too long its time once more. If it
        ends within this time, the controller brings the machine to rest, and the child process ends by itself."""
        if self._rest_seconds and self._process is not None:
            self._process.terminate()
            self._await_end()

    def _await_end(self) -> None:
        """Wait until the child process has closed its environment, and count the last steps of its fallback
        controller."""
        assert self._process is not None
        assert self._pipe is not None
        self._process.join(self._step_limit + self._rest_seconds + CLOSE_LIMIT)
        self._count_last_steps()

    def _count_last_steps(self) -> None:
        """Count the last steps of the fallback controller of a child process that has ended."""
        with suppress(EOFError, OSError):
            while self._pipe is not None and self._pipe.poll():
                *_, self._fallback_steps = self._pipe.recv()

    def _await_answer(self, pipe: Connection, limit: float) -> tuple[bool | None, Any] | None:
        """Return the answer (ok, value) to the latest request; None after ``limit`` seconds. Answers to earlier
        requests are skipped. Each has the number of steps of the fallback controller."""
        deadline = time.monotonic() + limit
        while pipe.poll(max(0.0, deadline - time.monotonic())):
            answered, ok, value, self._fallback_steps = pipe.recv()
            if answered == self._number:
                return ok, value
        return None

    def _start(self) -> Connection:
        if self._pipe is not None and self._process is not None and self._process.is_alive():
            return self._pipe
        self._kill()
        self._earlier_steps, self._fallback_steps = self.fallback_steps, 0
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, self._factory, self._step_limit, self._fallback)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        try:
            self._await_start(self._pipe)
        except KeyboardInterrupt:
            self._kill()  # the child's first message is still unread, and `close` would take it for an answer
            raise
        return self._pipe

    def _await_start(self, pipe: Connection) -> None:
        try:
            if not pipe.poll(START_LIMIT):
                self._kill()
                raise StepTimedOut(f"the environment took longer than {START_LIMIT:g} s to start: make it start faster")
            ok, value = pipe.recv()
        except EOFError as error:
            raise EnvironmentDied(
                f"the environment's process ended with exit code {self._kill()} at its start: see what it printed"
            ) from error
        if not ok:
            self._kill()
            raise UnknownEnvironment(value)
        self._rest_seconds, self.parallel = value

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


class _Ending:
    """Handler that ends the child process on SIGTERM, but lets a running step finish first.

    Args:
        seconds: if the parent ends, the child is ended after this time at the latest, even within a step.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._working = self._ending = False
        signal.signal(signal.SIGTERM, self._end_soon)

    def _end_soon(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._ending = True
        if not self._working:
            sys.exit()

    def __enter__(self) -> None:
        self._working = True

    def __exit__(self, *_: object) -> None:
        self._working = False
        if self._ending:
            sys.exit()


def _serve(pipe: Connection, factory: Factory, step_limit: float, fallback: str | None) -> None:
    """Run the child process: make the environment, and answer requests until the parent closes.

    The first answer (ok, value) says whether the environment was made. Then one answer to each request follows. What
    the environment prints goes to standard error, because the output of a command may be JSON.
    """
    sys.stdout = sys.stderr
    for number in PARENTS_BUSINESS:
        signal.signal(number, signal.SIG_IGN)
    working = _Ending(step_limit + CLOSE_LIMIT)
    threading.Thread(target=_exit_after_parent, args=(working,), daemon=True).start()
    with working:
        try:
            environment = keeping_limits(answering(factory()), fallback)
        except RAISED as error:
            pipe.send((False, sentence(error)))
            return
    closed, rest_seconds = False, getattr(environment, "rest_seconds", 0.0)
    working.seconds += rest_seconds
    try:
        pipe.send((True, (rest_seconds, runs_in_parallel(environment))))
        while not closed:
            closed = _serve_one(pipe, environment, working) == "close"
    except (EOFError, OSError):
        return  # the parent has ended
    finally:
        if not closed:
            with working:  # so that a second SIGTERM does not interrupt the fallback controller
                environment.close()
                with suppress(OSError):  # the parent may have ended
                    pipe.send((0, True, None, getattr(environment, "fallback_steps", 0)))


def _serve_one(pipe: Connection, environment: Environment, working: _Ending) -> str:
    """Answer one request, and return its method. Raises ``SystemExit`` if the environment's code called ``sys.exit``
    or raised ``KeyboardInterrupt``."""
    number, method, arguments = pipe.recv()
    with working:
        ok, value = _answer(environment, method, arguments)
        pipe.send((number, ok, value, getattr(environment, "fallback_steps", 0)))
        if ok is None:
            sys.exit()  # ``_serve`` closes the environment
    return str(method)


def _answer(environment: Environment, method: str, arguments: tuple[Any, ...]) -> tuple[bool | None, Any]:
    """Call a method of the environment, and return the answer (ok, value). ``ok`` is None if the method called
    ``sys.exit`` or raised ``KeyboardInterrupt`` (Ctrl-C does not reach this process), False if it raised an error."""
    try:
        value = getattr(environment, method)(*arguments)
        return True, value.model_dump() if isinstance(value, EnvironmentSpec) else value
    except (StepRefused, FallbackFailed) as error:  # the sampler acts on these
        return False, type(error)(str(error))
    except Exception as error:
        return False, sentence(error)
    except (SystemExit, KeyboardInterrupt, GeneratorExit) as error:
        return None, sentence(error)


def _exit_after_parent(working: _Ending) -> None:
    """Wait for the end of the parent process, and exit some seconds later, so that the environment can close."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        time.sleep(working.seconds)
        os._exit(1)
