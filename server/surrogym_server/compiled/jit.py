"""Functions in machine code, kept on disk for the next process."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit
from numba.core import config

F = TypeVar("F", bound=Callable[..., Any])

settings: Any = config  # numba fills it from its environment variables
logger = logging.getLogger(__name__)

OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}
INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, **OPTIONS}


def compiled(function: F) -> F:
    """Compile a function that compiled code calls. A product and a sum may round once together."""
    return cast(F, njit(fastmath={"contract"}, **INNER)(function))


def inlined(function: F) -> F:
    """The same for a function that is called from one place: it is compiled there and nowhere else."""
    return cast(F, njit(fastmath={"contract"}, inline="always", **INNER)(function))


def summing(function: F) -> F:
    """The same, where a sum may be taken in the order that the processor likes best, always the same one."""
    return cast(F, njit(fastmath={"contract", "reassoc"}, **INNER)(function))


def entry(*arguments: Any) -> Callable[[F], F]:
    """Compile a function that Python calls with arguments of these types, or load what an earlier process compiled."""

    def compile_or_load(function: F) -> F:
        chosen: dict[str, Any] = {"fastmath": {"contract"}, **OPTIONS}
        folder = _folder()
        if folder is not None:
            try:
                with _kept_in(folder):
                    return cast(F, njit([arguments], cache=True, **chosen)(function))
            except Exception as error:  # numba reads its files with pickle, and writes them where it may
                logger.warning("compiled steps can't be kept in %s, so they are compiled again: %s", folder, error)
        return cast(F, njit([arguments], **chosen)(function))

    return compile_or_load


@cache
def _folder() -> Path | None:
    """Where compiled functions are kept, one folder for each version of their sources; None where nothing can be.

    Numba reads its files with pickle, so the folder has to be the user's own.
    """
    chosen = settings.CACHE_DIR or os.environ.get("XDG_CACHE_HOME")
    try:
        folder = Path(chosen) if chosen else Path.home() / ".cache"
        folder = folder / "surrogym" / _digest_of_sources()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.stat()
        own = not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not state.st_mode & 0o022)
        return folder if own and os.access(folder, os.W_OK) else None
    except (OSError, RuntimeError):  # no home, or a read-only one
        return None


def _digest_of_sources() -> str:
    """Of all compiled files: numba looks at the file of the function that is called alone."""
    root = Path(__file__).parents[1]
    files = sorted({*root.glob("**/compiled/*.py"), *root.glob("**/compiled.py")})
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


@contextmanager
def _kept_in(folder: Path) -> Iterator[None]:
    """Numba chooses the place when a function is declared."""
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(folder)
    try:
        yield
    finally:
        settings.CACHE_DIR = before
