"""Computation of the rows of one call in several threads. Compiled code does not hold the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def side_by_side(function: Callable[[slice], None], rows: int, block: int, threads: int) -> None:
    """Call ``function`` for all ``rows``, divided into as many slices as threads, each of whole blocks of rows.

    The calling thread computes one slice. The other threads are new ones, because a forked process inherits none.
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
