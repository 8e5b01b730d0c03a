"""A running program: its start, its requests within a time limit, its standard error, and its end, even if the process
that started it was killed."""

from __future__ import annotations

import math
import os
import select
import selectors
import shlex
import signal
import subprocess
import threading
import time
from contextlib import suppress
from typing import IO

from surrogym_sampler.original.errors import (
    EnvironmentDied,
    RequestRefused,
    StepFailed,
    StepRefused,
    StepTimedOut,
    UnknownEnvironment,
)
from surrogym_sampler.original.executables.messages import LONGEST_LINE, Reply, decode, encode, short

SHELL = "/bin/sh"
# `read` returns when this process ends, which closes the pipe to the shell's input. $1 is the time to wait in seconds,
# $0 the id of the process group to kill.
SCRIPT = 'read -r _; sleep "$1"; kill -s KILL -- "-$0"'


class Guard:
    """A shell that waits for the end of this process, and then kills a process group.

    The shell is a process of its own, so it also works after SIGKILL of this process, on Linux and macOS.

    Args:
        group: id of the process group.
        grace: seconds between the end of this process and the kill, in which a running step may finish.

    Raises:
        OSError: the shell can't be started.
    """

    def __init__(self, group: int, grace: float) -> None:
        self._shell = subprocess.Popen(
            [SHELL, "-c", SCRIPT, str(group), str(math.ceil(grace))],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def dismiss(self) -> None:
        """End the guard. Call this before the process group's id can be given to other processes."""
        assert self._shell.stdin is not None
        self._shell.kill()
        self._shell.wait()
        self._shell.stdin.close()


OWN = 2  # file descriptor of this process's standard error
TAIL = 4096  # number of last bytes of the program's standard error that are kept
SHOWN = 200  # largest number of characters of the last line in an error
PATIENCE = 0.1  # a piece of output is dropped if this process's standard error does not accept it within these seconds
LAST_SECONDS = 1.0  # seconds to read the output of an ended program; a process that it started may hold the pipe open


class StandardError:
    """The standard error of a running program. A thread reads it, so that the program never waits for a reader.

    A piece that this process's own standard error does not accept in time is dropped.

    Args:
        pipe: the end of the pipe to read from. The thread closes it.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._tail = b""
        self._thread = threading.Thread(target=self._pass_on, name="standard error", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Wait until the output of an ended program is read, at most ``LAST_SECONDS``."""
        self._thread.join(LAST_SECONDS)

    def last_line(self) -> str:
        """Return the printable characters of the last line that is not empty; "" if there is none."""
        lines = self._tail.decode(errors="replace").splitlines()
        printable = ("".join(filter(str.isprintable, line)).strip() for line in reversed(lines))
        last = next(filter(None, printable), "")
        return last if len(last) <= SHOWN else f"{last[:SHOWN]}…"

    def _pass_on(self) -> None:
        taken = True
        with self._pipe:
            while piece := os.read(self._pipe.fileno(), select.PIPE_BUF):
                self._tail = (self._tail + piece)[-TAIL:]
                taken = _write(piece, PATIENCE if taken else 0.0)


def _write(piece: bytes, seconds: float) -> bool:
    """Write to this process's standard error, and return whether it accepted the piece within ``seconds``. A pipe that
    is ready accepts ``PIPE_BUF`` bytes without waiting."""
    try:
        ready = bool(select.select([], [OWN], [], seconds)[1])
        return ready and os.write(OWN, piece) > 0
    except OSError:  # this process's standard error is closed
        return False


GRACE_SECONDS = 30.0  # seconds that a running step may still take after this process was killed
END_SECONDS = 2.0  # seconds to wait for the program's end after the request to close, and again after SIGTERM
CHUNK = 1 << 16  # largest number of bytes read at once


class Program:
    """A program that is started without a shell, in a session of its own, so that Ctrl-C does not reach it.

    Its standard error is passed on to that of this process. After a time-out, or a line that is not an answer, the
    program is killed; ``start`` starts it again. A program with a fallback controller first sees the end of its
    standard input, and has time to bring its machine to rest. If this process is killed, the program sees the end of
    its standard input, and is killed some time later.

    Args:
        command: the program and its arguments, quoted as for a shell.
        called: the program's name in errors.
        grace: seconds that a running step may still take after this process was killed.

    Raises:
        UnknownEnvironment: the command is empty, or its quotes don't match.
    """

    def __init__(self, command: str, called: str = "the program", grace: float = GRACE_SECONDS) -> None:
        self._called, self._grace = called, grace
        self._falls_back = False
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise UnknownEnvironment(
                f"expected a command such as './plant --port 7', got {command!r}: {error}"
            ) from error
        if not self._words:
            raise UnknownEnvironment(
                "expected a command such as './plant --port 7', got an empty one: write it behind exec:"
            )
        if os.name == "nt":
            raise UnknownEnvironment(
                "expected Linux or macOS to start a program, got Windows: run the sampler on one of these; the server "
                "may run elsewhere"
            )
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: Guard | None = None
        self._standard_error: StandardError | None = None
        self._unread = bytearray()
        self._number = 0  # id of the last request

    @property
    def running(self) -> bool:
        """Whether the process exists and has not ended."""
        return self._process is not None and self._process.poll() is None

    def grant(self, seconds: float) -> None:
        """Let the program run these seconds longer after this process was killed, so that its fallback controller can
        act. This also holds after the program is started again."""
        self._grace += seconds
        self._falls_back = True
        if self._guard is not None and self._process is not None:
            self._guard.dismiss()
            self._guard = Guard(self._process.pid, self._grace)

    def start(self) -> None:
        """Start the program; one that still runs is ended first.

        Raises:
            UnknownEnvironment: there is no such program, or it can't be executed.
        """
        self.end()
        try:
            self._process = subprocess.Popen(
                self._words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,
            )
            self._guard = Guard(self._process.pid, self._grace)
        except OSError as error:
            raise UnknownEnvironment(
                f"expected a program that can be started, got {self._words[0]!r} ({error}): check its path and "
                "permissions"
            ) from error
        self._unread.clear()
        assert self._process.stdin is not None
        assert self._process.stderr is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        self._standard_error = StandardError(self._process.stderr)

    def ask(self, method: str, deadline: float, **fields: object) -> Reply:
        """Send one request, and return the result.

        Args:
            method: the request's name, such as ``step``.
            deadline: when the answer must be complete, in seconds on the monotonic clock.
            fields: the request's other entries.

        Raises:
            RequestRefused, StepRefused: the program answered with an error, and keeps running.
            StepFailed: the program died, hung or sent something else than an answer; it was killed.
        """
        self._number += 1
        answer = self.exchange(encode(self._number, method, **fields), method, deadline)
        try:
            return decode(answer, self._number)
        except (RequestRefused, StepRefused):
            raise
        except StepFailed:
            self._end_after_fault()
            raise

    def exchange(self, line: bytes, what: str, deadline: float) -> bytes:
        """Send one line, and return the next line that the program prints, without the line's end.

        Args:
            line: the line with its end.
            what: name of the request, for errors.
            deadline: when the answer must be complete, in seconds on the monotonic clock.

        Raises:
            StepFailed: the program died, hung or printed too long a line; it was killed.
        """
        try:
            self._write(line, what, deadline)
            return self._read(what, deadline)
        except StepFailed:
            self._end_after_fault()
            raise

    def _end_after_fault(self) -> None:
        """End the program. One with a fallback controller may first finish its step and bring its machine to rest."""
        if self._falls_back:
            self.end_input()
            self.wait(self._grace)
        self.end()

    def surplus(self, seconds: float) -> bytes:
        """Wait up to ``seconds``, and return what the program printed after its last answer."""
        if self._process is not None and self._process.stdout is not None:
            with selectors.DefaultSelector() as selector:
                selector.register(self._process.stdout.fileno(), selectors.EVENT_READ)
                if selector.select(seconds):
                    self._unread += os.read(self._process.stdout.fileno(), CHUNK)
        return bytes(self._unread)

    def end_input(self) -> None:
        """Close the program's standard input."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def wait(self, seconds: float) -> int | None:
        """Return the program's exit code; None if it still runs after ``seconds``, or was not started."""
        try:
            return None if self._process is None else self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def close(self) -> None:
        """Ask the program to close, and kill it if it does not."""
        process = self._process
        if process is not None and self.running:
            assert process.stdin is not None
            with suppress(OSError, StepFailed):
                self._write(encode(self._number + 1, "close"), "close", time.monotonic() + END_SECONDS)
                process.stdin.close()
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_SECONDS)
        self.end()

    def end(self) -> int | None:
        """End the program and all processes that it has started, by SIGTERM, then by SIGKILL.

        Returns:
            Its exit code; None if there was no program.
        """
        process, self._process = self._process, None
        if process is None:
            return None
        if self._guard is not None:
            self._guard.dismiss()
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError, PermissionError):
                # the whole group, because processes that the program started may outlive it
                os.killpg(process.pid, number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_SECONDS)
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        if self._standard_error is not None:
            self._standard_error.finish()
        return process.wait()

    def _write(self, line: bytes, method: str, deadline: float) -> None:
        process = self._process
        if process is None or process.stdin is None:
            raise EnvironmentDied(
                f"expected a running program for the request {method}, got none: start the program first"
            )
        begun, left = time.monotonic(), memoryview(line)
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdin.fileno(), selectors.EVENT_WRITE)
            while left:
                if not selector.select(max(0.0, deadline - time.monotonic())):
                    raise StepTimedOut(
                        f"{self._called} read only {len(line) - len(left)} of {len(line)} bytes of {method} within "
                        f"{max(0.0, deadline - begun):.3g} s and was ended{self._complaint()}"
                    )
                try:
                    left = left[os.write(process.stdin.fileno(), left) :]
                except BlockingIOError:
                    continue
                except OSError as error:
                    raise self._death(method, "input") from error

    def _read(self, method: str, deadline: float) -> bytes:
        assert self._process is not None
        assert self._process.stdout is not None
        begun, output = time.monotonic(), self._process.stdout.fileno()
        searched = 0
        with selectors.DefaultSelector() as selector:
            selector.register(output, selectors.EVENT_READ)
            while (end := self._unread.find(b"\n", searched)) < 0:
                searched = len(self._unread)
                if searched > LONGEST_LINE:
                    raise StepFailed(
                        f"expected a line of at most {LONGEST_LINE} bytes from the program, got a longer one: "
                        "print logs to standard error"
                    )
                left = deadline - time.monotonic()
                if left <= 0 or not selector.select(left):
                    raise StepTimedOut(
                        f"{self._called} did not answer {method} within {max(0.0, deadline - begun):.3g} s and was "
                        f"ended{self._unfinished()}{self._complaint()}"
                    )
                if not (chunk := os.read(output, CHUNK)):
                    raise self._death(method, "output")
                self._unread += chunk
        line = bytes(self._unread[:end])
        del self._unread[: end + 1]
        return line

    def _unfinished(self) -> str:
        """Return the end of an error message that quotes a line which the program did not finish; empty without it."""
        return f"; it printed {short(bytes(self._unread))} without an end of the line" if self._unread else ""

    def _death(self, method: str, closed: str) -> EnvironmentDied:
        """Return the error for a program that closed its standard ``closed`` (input or output) during a request. The
        program first gets some time to end by itself."""
        code = self.wait(END_SECONDS)
        printed = self.surplus(0.0)
        after = f", after it printed {short(printed)}" if printed.strip() else ""
        self.end()
        did = f"closed its standard {closed} and was ended" if code is None else f"ended with exit code {_named(code)}"
        return EnvironmentDied(f"{self._called} {did} during {method}{after}{self._complaint()}")

    def _complaint(self) -> str:
        """Return the end of an error message that quotes the program's standard error; empty if it wrote nothing."""
        last = "" if self._standard_error is None else self._standard_error.last_line()
        return f"; the last line of its standard error: {last}" if last else ""


def _named(code: int) -> str:
    """Return an exit code in words, with the signal's name if a signal ended the program."""
    try:
        return f"{code} ({signal.Signals(-code).name})" if code < 0 else str(code)
    except ValueError:  # a real-time signal, which has no name
        return str(code)
