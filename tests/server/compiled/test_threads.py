"""Rows that several threads compute are each computed once, in whole blocks, and errors reach the caller."""

from __future__ import annotations

import threading

import pytest

from surrogym_server.compiled.threads import side_by_side


@pytest.mark.parametrize(("rows", "threads"), [(1_024, 2), (1_000, 3), (33, 4), (10, 2), (64, 1), (1, 8)])
def test_threads_compute_each_row_once_in_whole_blocks(rows, threads):
    done: list[slice] = []
    side_by_side(done.append, rows, 32, threads)
    done.sort(key=lambda at: at.start)
    assert [row for at in done for row in range(at.start, at.stop)] == list(range(rows))
    assert all(at.start % 32 == 0 for at in done)
    assert len(done) <= min(threads, -(-rows // 32))


def test_the_calling_thread_computes_rows_of_a_batch_too():
    names: list[str] = []
    side_by_side(lambda _: names.append(threading.current_thread().name), 128, 32, 4)
    assert len(names) == 4
    assert threading.current_thread().name in names


@pytest.mark.parametrize("at_fault", [0, 32])
def test_an_error_in_a_row_thread_reaches_the_caller(at_fault):
    def fails(at: slice) -> None:
        if at.start == at_fault:
            raise ArithmeticError("rows")

    with pytest.raises(ArithmeticError, match="rows"):
        side_by_side(fails, 64, 32, 2)
