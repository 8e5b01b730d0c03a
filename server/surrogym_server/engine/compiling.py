"""Compilation of steps in a child process, before the first session opens. While numba compiles, it blocks all threads
of its process."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress

from surrogym_shared import compiled
from surrogym_shared.compiled import disk_cache

PROGRAM = """
import os
if hasattr(os, "nice"):
    os.nice(10)
import surrogym_server.models.gaussian_process.prediction.compiled.regions
import surrogym_server.models.gaussian_process.prediction.compiled.step
import surrogym_server.virtual.compiled.step
import surrogym_server.virtual.words
"""
PACKAGE = "surrogym_server"
LONGEST = 120.0  # the first sessions wait at most this many seconds for the child process, then compile the code too


class Compiling:
    """A child process that compiles the numba functions of steps and stores them in a cache on the disk."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the child process, unless numba or the disk cache can't be used, or compiled code is there already."""
        is_cold = compiled.available() and disk_cache.folder(PACKAGE) is not None and not disk_cache.has_any(PACKAGE)
        if self._process is None and is_cold:
            self._process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
            )

    def wait(self) -> None:
        """Wait until the compilation has ended, at most ``LONGEST`` seconds. This blocks, so call it in a thread."""
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LONGEST)

    def close(self) -> None:
        """Kill the child process, if it was started."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
