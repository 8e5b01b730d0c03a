"""Rows of one call, computed in several threads. Compiled code holds no lock of the interpreter."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def side_by_side(function: Callable[[slice], None], rows: int, block: int, threads: int) -> None:
    """Call ``function`` for all ``rows``, divided into as many slices as threads, each of whole blocks of rows.

    The caller's thread computes one slice. The other threads are new, because a process that is forked keeps none.
    """
    blocks = -(-rows // block)
    share = block * -(-blocks // threads)
    first, *others = (slice(begin, min(begin + share, rows)) for begin in range(0, rows, share))
    if not others:
        function(first)
        return
    with ThreadPoolExecutor(len(others)) as pool:
        waiting = [pool.submit(function, at) for at in others]
        function(first)
        for one in waiting:
            one.result()
