"""Computation of blocks of rows in several threads. Compiled code does not hold Python's global interpreter lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def side_by_side(function: Callable[[slice], None], rows: int, block: int, threads: int) -> None:
    """Call ``function`` with slices that together cover all ``rows``, at the same time in at most ``threads`` threads.
    Each slice but the last consists of whole blocks of ``block`` rows.

    The calling thread computes one slice. The other threads are started for this call, because a forked process does
    not inherit running threads.
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
