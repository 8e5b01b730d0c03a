"""The C compiler of this machine."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

COMPILERS = ("cc", "gcc", "clang")
SECONDS = 600  # longest time that a compilation may take
SHOWN = 2_000  # an error shows at most this many characters of the compiler's output


class CannotCompile(RuntimeError):
    """No C compiler was found, or the compiler refused the sources. The message has the compiler's output."""


def c_compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler: the variable ``CC``, or the first of cc, gcc and clang on the search path.
    None if there is no compiler.

    Raises:
        CannotCompile: ``CC`` names no program.
    """
    if text := os.environ.get("CC", "").strip():
        try:
            command = tuple(shlex.split(text))
        except ValueError:  # raised if a quotation mark in the variable is not closed
            command = ()
        if not command or shutil.which(command[0]) is None:
            raise CannotCompile(f"expected the variable CC to name a C compiler on the search path, got {text!r}")
        return command
    return next(((name,) for name in COMPILERS if shutil.which(name)), None)


def require_c_compiler() -> tuple[str, ...]:
    """Return the command of the C compiler. Raises ``CannotCompile`` if there is none."""
    if (command := c_compiler()) is None:
        raise CannotCompile(
            f"expected a C compiler ({', '.join(COMPILERS)}) on the search path, got none: install one or set CC"
        )
    return command


def compile_c(command: Sequence[str], flags: Sequence[str], sources: Sequence[str], out: Path, folder: Path) -> None:
    """Compile C sources.

    Args:
        command: the compiler's program and its first arguments.
        flags: further options of the compiler.
        sources: names of the C files in ``folder``.
        out: file to write.
        folder: folder in which the compiler runs.

    Raises:
        CannotCompile: the compiler refused the sources.
    """
    whole = [*command, *flags, "-o", str(out), *sources, "-lm"]
    try:
        process = subprocess.run(whole, cwd=folder, capture_output=True, text=True, timeout=SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CannotCompile(
            f"the C compiler {command[0]!r} can't be run: {error}; set the variable CC to another compiler"
        ) from error
    if process.returncode:
        message = process.stderr[:SHOWN].strip() or f"exit status {process.returncode}"
        raise CannotCompile(
            f"the C compiler {command[0]} refused the sources: {message}; set the variable CC to another one, or "
            "report this"
        )
