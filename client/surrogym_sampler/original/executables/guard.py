"""A guard that kills a program after the process that started it was killed."""

from __future__ import annotations

import math
import subprocess

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
