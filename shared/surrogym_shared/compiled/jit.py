"""Compile functions to machine code, and keep them on disk for the next process."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit
from numba.core import config
from numba.core.errors import NumbaError

from surrogym_shared.compiled import disk_cache

F = TypeVar("F", bound=Callable[..., Any])

settings: Any = config  # numba's settings, whose attributes numba sets from environment variables
logger = logging.getLogger(__name__)

OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}
INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, **OPTIONS}


def compiled(function: F) -> F:
    """Compile a function that only compiled code calls. A multiplication and the addition that follows may become one
    operation (fused multiply-add), which rounds once."""
    return cast(F, njit(fastmath={"contract"}, **INNER)(function))


def inlined(function: F) -> F:
    """Compile a function inline, as a part of the compiled function that calls it."""
    return cast(F, njit(fastmath={"contract"}, inline="always", **INNER)(function))


def summing(function: F) -> F:
    """Compile a function whose sums may be reordered for speed. The chosen order is the same in every call."""
    return cast(F, njit(fastmath={"contract", "reassoc"}, **INNER)(function))


def entry(*arguments: Any) -> Callable[[F], F]:
    """Compile a function that Python calls with arguments of these types, or load what an earlier process compiled."""

    def compile_or_load(function: F) -> F:
        chosen: dict[str, Any] = {"fastmath": {"contract"}, **OPTIONS}
        folder = disk_cache.folder(function.__module__.partition(".")[0])
        if folder is not None:
            try:
                with _kept_in(folder):
                    return cast(F, njit([arguments], cache=True, **chosen)(function))
            except NumbaError:
                raise  # compiling without the cache would fail too
            except Exception as error:  # a cache file can't be unpickled, or the folder can't be written
                logger.warning(
                    "compiled code can't be stored in %s, so the functions are compiled again: %s", folder, error
                )
        return cast(F, njit([arguments], **chosen)(function))

    return compile_or_load


@contextmanager
def _kept_in(folder: Path) -> Iterator[None]:
    """Context in which numba caches the code of the functions that it compiles in this folder."""
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(folder)
    try:
        yield
    finally:
        settings.CACHE_DIR = before
