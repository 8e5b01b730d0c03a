"""Ends a program whose parent was killed and could not end it."""

from __future__ import annotations

import math
import subprocess

SHELL = "/bin/sh"
SCRIPT = 'read -r _; sleep "$1"; kill -s KILL -- "-$0"'  # its input ends with the process that holds the other end


class Guard:
    """A shell that waits for the end of this process, and then kills a process group.

    Nothing in this process needs to run for that, so it also works after SIGKILL, on Linux and macOS.

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
        """End the guard. Call this before the group's id can belong to other processes."""
        assert self._shell.stdin is not None
        self._shell.kill()
        self._shell.wait()
        self._shell.stdin.close()
