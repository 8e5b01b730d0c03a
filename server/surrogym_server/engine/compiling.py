"""Compile steps before the first session opens, in another process, because numba would block the threads of
this one."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress

from surrogym_shared import compiled
from surrogym_shared.compiled import kept

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
LONGEST = 120.0  # seconds that a session waits for it; after that it compiles itself


class Compiling:
    """A process that compiles steps."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, unless steps can't be compiled and kept on disk, or an earlier process has compiled them."""
        to_be_kept = compiled.available() and kept.folder(PACKAGE) is not None and not kept.has_any(PACKAGE)
        if self._process is None and to_be_kept:
            self._process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
            )

    def wait(self) -> None:
        """Wait until it has ended, with or without success. Call it in a thread."""
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LONGEST)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
