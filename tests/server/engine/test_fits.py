"""The process that fits: apart from this one, replaced when it dies, and gone when it is told so."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from support import jobs
from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.fits import NICENESS, Fits
from surrogym_server.errors import PluginFailed, Unavailable

Started = Callable[[Callable[[DesignJob], DesignResult]], Fits]


class Job:
    """Stands for a design job; the functions here read its state alone."""

    def __init__(self, **state: Any) -> None:
        self.state = state


@pytest.fixture
def started() -> Iterator[Started]:
    made: list[Fits] = []

    def start(function: Callable[[DesignJob], DesignResult]) -> Fits:
        made.append(Fits(function))
        return made[-1]

    yield start
    for fits in made:
        fits.close()


def run(fits: Fits, **state: Any) -> DesignResult:
    return asyncio.run(fits.run(cast(DesignJob, Job(**state))))


def test_a_job_is_done_in_another_process(started: Started):
    fits = started(jobs.answer)
    assert run(fits).data_hash not in ("", str(os.getpid()))
    assert run(fits).data_hash == run(fits).data_hash, "one process does them all"


def test_it_yields_to_whoever_steps(started: Started):
    process = int(run(started(jobs.answer)).data_hash)
    mine = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, process) == min(mine + NICENESS, 19)


def test_a_package_that_exits_ends_one_fit_and_no_server(started: Started):
    with pytest.raises(PluginFailed, match=r"a package called sys\.exit: SystemExit: no licence"):
        run(started(jobs.leave))


def test_what_a_job_raises_comes_here(started: Started):
    with pytest.raises(ValueError, match="no such luck"):
        run(started(jobs.refuse))


def test_a_process_that_dies_is_replaced_and_the_job_done_again(started: Started, tmp_path: Path):
    mark = tmp_path / "died"
    assert run(started(jobs.die_once), mark=str(mark)).verdict == "ready"
    assert mark.exists()


def test_a_job_that_kills_every_process_is_given_up(started: Started):
    fits = started(jobs.die)
    with pytest.raises(Unavailable, match="died twice"):
        run(fits)


def test_closing_ends_the_process_in_the_middle_of_a_fit(started: Started, tmp_path: Path):
    fits, mark = started(jobs.hang), tmp_path / "mark"

    async def close_while_it_hangs() -> int:
        job = asyncio.create_task(fits.run(cast(DesignJob, Job(mark=str(mark)))))
        while not mark.exists() or not mark.read_text():
            await asyncio.sleep(0.01)
        job.cancel()
        await asyncio.to_thread(fits.close)
        return int(mark.read_text())

    process = asyncio.run(close_while_it_hangs())
    deadline = time.monotonic() + 30
    while _alive(process):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_closing_does_not_wait_for_a_process_that_is_still_starting(started: Started):
    """It imports for seconds where others keep the machine busy, and a stop of the server would wait for it."""
    beginning = time.monotonic()
    run(started(jobs.answer))
    whole_start = time.monotonic() - beginning
    fits = started(jobs.answer)
    fits.start()
    closing = time.monotonic()
    fits.close()
    assert time.monotonic() - closing < whole_start / 2


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
